"""Who decides: fixed schedules, rules, planners, learned policies; their training, evaluation and reports."""

from __future__ import annotations

from typing import Any

DISTRIBUTION = "passive-env"


def pretrained_ids() -> list[str]:
    """Ids of the environments that have a pretrained policy in the package."""
    from agents import pretrained  # here, so that `import agents` stays quick

    return pretrained.pretrained_ids()


def load_pretrained(environment: str, scenario: Any = None) -> Any:
    """The pretrained policy of an environment; arguments and errors as of `agents.pretrained.load_pretrained`."""
    from agents import pretrained

    return pretrained.load_pretrained(environment, scenario)

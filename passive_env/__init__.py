"""Gymnasium environments in which real passive-sensor trackers run and reward goes to maneuvers that help them.

Importing this package registers the environments ``passive/…-v0``.
"""

from __future__ import annotations

from passive_env.distribution import check_names

check_names()

from passive_env.belief import Belief  # noqa: E402
from passive_env.env import PassiveEnv  # noqa: E402
from passive_env.parallel import parallel_env  # noqa: E402
from passive_env.registration import register_all  # noqa: E402
from passive_env.scenario import Scenario  # noqa: E402
from passive_env.vector_env import PassiveVectorEnv  # noqa: E402

register_all()

__version__ = "0.1.0"
__all__ = ["Belief", "PassiveEnv", "PassiveVectorEnv", "Scenario", "__version__", "parallel_env"]

"""Training runs in tests: small evaluations, interruptions, and what was logged."""

from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator, ScalarEvent

from agents import training
from agents.training import Checkpoints, Run, train


def finish(run: Run, evaluation_episodes: int) -> Run:
    """Train to the end, evaluating few episodes on the way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "EVALUATION_EPISODES", evaluation_episodes)
        train(run, progress=False)
    return run


def interrupt(run: Run, after: int) -> None:
    """Train until so many steps are behind, then interrupt as Ctrl-C does."""
    proceed = Checkpoints._on_step

    def stop(self):
        if self.num_timesteps > after:
            raise KeyboardInterrupt
        return proceed(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Checkpoints, "_on_step", stop)
        with pytest.raises(KeyboardInterrupt):
            train(run, progress=False)


def logged(folder: Path) -> dict[str, list[ScalarEvent]]:
    """Every curve's points, with step and value, from a run's TensorBoard logs."""
    events = EventAccumulator(str(next((folder / "tensorboard").rglob("events.out.tfevents.*")).parent))
    events.Reload()
    return {tag: events.Scalars(tag) for tag in events.Tags()["scalars"]}

"""What all scenarios share in which targets fly courses, drawn or recorded: how many steps, and whose flights."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from passive_env.core import Simulation
from passive_env.flights import FlightPaths, load_flights
from passive_env.scenario import Scenario, choice, free, integer, number
from passive_env.team import Steering


@dataclass(frozen=True, kw_only=True)
class CourseScenario(Scenario):
    """Base of all scenarios of the catalogue."""

    ordered: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Pairs of fields of which the first must not exceed the second."""
    sight: ClassVar[tuple[str, ...]] = ()
    """Fields that decide what an agent sees, not what happens; with "actions" they are its interface: a policy trained
    with some flies with others."""

    replay_axis: ClassVar[str] = "time [s]"
    """What `passive_env.layers.Instant.at` counts."""

    course: str = choice("random", ("random", "flights"), "target motion: drawn, or recorded flights")
    steps: int = integer(45, 1, 10_000, "decisions per episode")
    step_s: float = number(2.0, 0.1, 60.0, "time between scans")
    flights: Any = free(None, "file of recorded flights for course='flights'; None takes the shipped one")
    flight_split: str = choice("train", ("train", "test", "all"), "aircraft used for course='flights'")

    def __post_init__(self) -> None:
        super().__post_init__()
        for low, high in self.ordered:
            if getattr(self, low) > getattr(self, high):
                raise self._error(low, f"must not exceed {high} = {getattr(self, high)}")
        if not isinstance(self.flights, (str, os.PathLike, type(None))):
            raise self._error("flights", "must be the path of a file, or None")
        if self.flights is not None and self.course != "flights":
            raise self._error("flights", f"is not used with course={self.course!r}; add course='flights'")

    def _error(self, field: str, allowed: str) -> ValueError:
        return ValueError(f"{type(self).__name__}.{field} = {getattr(self, field)!r}: {allowed}")

    def make_simulation(self) -> Simulation:
        """The loop that runs this scenario's episodes."""
        return Simulation(self)

    @property
    def steering(self) -> Steering | None:
        """Which numbers of a command steer which platform; None where no two platforms are steered at a time."""
        return None

    def make_own_observation(self) -> Any:
        """What every steered platform knows by itself, of beliefs to [e, s, d].

        Raises:
            ValueError: there is no such share of the belief.
        """
        raise ValueError(f"{type(self).__name__}: has no steered platforms that sense on their own")

    def interface(self) -> dict[str, Any]:
        """Values of the fields that decide how an agent sees and acts."""
        return {name: getattr(self, name) for name in ("actions", *self.sight)}

    @property
    def instants(self) -> int:
        """Instants of an episode at which a track is judged: the first scan, and the one after every decision."""
        return self.steps + 1

    def check_flights(self) -> None:
        """Load the recorded flights now, so that a bad file is found before anything else is done.

        Raises:
            OSError, ValueError: missing or malformed file, or no flight long enough for an episode.
        """
        if self.course == "flights":
            self.flight_paths.window_starts(self.instants - 1)

    @cached_property
    def flight_paths(self) -> FlightPaths:
        """Recorded flights of the chosen part at this scenario's instants."""
        return load_flights(self.flights).split(self.flight_split).resample(self.step_s)

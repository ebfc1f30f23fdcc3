"""Flights cut into blocks of episodes that workers fly, each on a core of its own.

A block's random numbers are those of its seeds and its policy is sent as it is, so a record does not depend on where
its blocks are flown. Every block's result is kept once, at its place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any, NamedTuple, Protocol

from agents.evaluation import Flight, blocks_of, fly_block, joined
from agents.outcomes import Record
from agents.policy import Policy
from trackers.compiled import single_thread

WAITING = 2
"""Blocks handed out per worker: the next one is there when one is finished, and memory is needed for few."""


class Block(NamedTuple):
    """A block that is being flown.

    Attributes:
        name, title: its flight's, for programs and for people.
        place: among that flight's blocks.
        episodes, seed: as of `agents.evaluation.fly`.
    """

    name: str
    title: str
    place: int
    episodes: int
    seed: int

    @property
    def span(self) -> str:
        """Its episodes, for people."""
        return f"episodes {self.seed} to {self.seed + self.episodes - 1}"


class Workers(Protocol):
    """Who flies blocks. A ticket stands for a block that is being flown, a package for a scenario and a policy."""

    count: int

    def pack(self, scenario: Any, policy: Policy) -> Any:
        """Make what is sent with every block of a flight."""

    def send(self, package: Any, block: Block) -> Any:
        """Have a block flown; returns its ticket."""

    def first(self, tickets: list[Any]) -> Any:
        """Wait for one ticket whose block is finished."""

    def result(self, ticket: Any, block: Block) -> dict[str, Any]:
        """Say what `agents.evaluation.fly_block` gave.

        Raises:
            whatever went wrong in it; OSError: its worker died.
        """
        ...


def fly_by(workers: Workers, flights: Mapping[str, Flight], bar: Any) -> Iterator[tuple[str, Record]]:
    """Fly as an `agents.evaluation.Engine` does, whatever is finished first coming first."""
    submitted = _submit(workers, flights)
    running = dict(islice(submitted, WAITING * workers.count))
    results: dict[str, dict[int, dict[str, Any]]] = {}
    while running:
        done = workers.first(list(running))
        block = running.pop(done)
        flight = flights[block.name]
        blocks = results.setdefault(block.name, {})
        blocks[block.place] = workers.result(done, block)
        bar.set_description(block.title)
        bar.update(block.episodes)
        running.update(islice(submitted, 1))
        if len(blocks) == len(blocks_of(flight.episodes, flight.seed)):
            yield block.name, joined([blocks[place] for place in sorted(blocks)], flight.scenario)
            del results[block.name]


def _submit(workers: Workers, flights: Mapping[str, Flight]) -> Iterator[tuple[Any, Block]]:
    """Hand out blocks, each when it is asked for: tickets, and whose they are."""
    for name, flight in flights.items():
        package = workers.pack(flight.scenario, flight.make())
        for place, (seed, episodes) in enumerate(blocks_of(flight.episodes, flight.seed)):
            block = Block(name, flight.title, place, episodes, seed)
            yield workers.send(package, block), block


def fly_alone(crew: tuple[Any, Policy], episodes: int, seed: int) -> dict[str, Any]:
    """A block on one core: the others have their own."""
    with single_thread():
        return fly_block(*crew, episodes, seed)

"""Evaluation on Ray: blocks of episodes as tasks, with the results of one process.

A block's random numbers are those of its seeds and its policy is sent as it is, so a record does not depend on where
its blocks are flown. A block whose worker dies is flown again, and every block's result is kept once, at its place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import Any, NamedTuple

from agents.distributed.cluster import cluster
from agents.evaluation import Engine, Flight, blocks_of, fly_block, joined
from agents.outcomes import Record
from agents.policy import Policy
from trackers.compiled import available_cores, single_thread

TRIES = 4
"""How often a block is begun at most, if its workers die."""

WAITING = 2
"""Blocks handed to Ray per worker: the next one is there when one is finished, and memory is needed for few."""


class Block(NamedTuple):
    """A block that is being flown: its flight's name, its place among that flight's blocks, and its episodes."""

    name: str
    place: int
    episodes: int
    seed: int


@contextmanager
def ray_engine(workers: int | None = None, address: str | None = None) -> Iterator[Engine]:
    """An engine on Ray, for as long as the cluster is there.

    Args:
        workers: blocks flown at once; None takes this machine's cores, or the running cluster's.
        address: of a running cluster; None starts one on this machine.
    Raises:
        ValueError: less than one worker; ImportError, ConnectionError: as of `cluster`.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"--workers {workers}: must be at least 1")
    with cluster(address, workers or available_cores()) as ray:
        width = workers or int(ray.cluster_resources().get("CPU", 1))
        yield lambda flights, bar: _fly(ray, width, flights, bar)


def _fly(ray: Any, width: int, flights: Mapping[str, Flight], bar: Any) -> Iterator[tuple[str, Record]]:
    submitted = _submit(ray, flights)
    running = dict(islice(submitted, WAITING * width))
    results: dict[str, dict[int, dict[str, Any]]] = {}
    while running:
        (done,), _ = ray.wait(list(running), num_returns=1)
        block = running.pop(done)
        flight = flights[block.name]
        blocks = results.setdefault(block.name, {})
        blocks[block.place] = _result(ray, done, flight.title, block)
        bar.set_description(flight.title)
        bar.update(block.episodes)
        running.update(islice(submitted, 1))
        if len(blocks) == len(blocks_of(flight.episodes, flight.seed)):
            yield block.name, joined([blocks[place] for place in sorted(blocks)], flight.scenario)
            del results[block.name]


def _submit(ray: Any, flights: Mapping[str, Flight]) -> Iterator[tuple[Any, Block]]:
    """Hand blocks to Ray, each when it is asked for: references to their results, and whose they are."""
    task = ray.remote(num_cpus=1, max_retries=TRIES - 1)(_fly_alone)
    for name, flight in flights.items():
        crew = ray.put((flight.scenario, flight.make()))
        for place, (seed, episodes) in enumerate(blocks_of(flight.episodes, flight.seed)):
            yield task.remote(crew, episodes, seed), Block(name, place, episodes, seed)


def _fly_alone(crew: tuple[Any, Policy], episodes: int, seed: int) -> dict[str, Any]:
    """A block on one core: the others have their own."""
    with single_thread():
        return fly_block(*crew, episodes, seed)


def _result(ray: Any, reference: Any, title: str, block: Block) -> dict[str, Any]:
    """A finished block.

    Raises:
        whatever went wrong in it; OSError: its workers died again and again.
    """
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause or error from None
    except ray.exceptions.RayError as error:
        raise OSError(
            f"{title}: the workers that flew episodes {block.seed} to {block.seed + block.episodes - 1} died "
            f"{TRIES} times ({type(error).__name__}); try fewer --workers if memory is short"
        ) from error

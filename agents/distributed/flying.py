"""Evaluation on Ray: blocks of episodes as tasks, with the results of one process.

A block whose worker dies is flown again.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from agents.distributed.blocks import Block, fly_alone, fly_by
from agents.distributed.cluster import cluster
from agents.evaluation import Engine
from agents.policy import Policy
from trackers.compiled import available_cores

TRIES = 4
"""How often a block is begun at most, if its workers die."""


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
        yield lambda flights, bar: fly_by(RayWorkers(ray, width), flights, bar)


class RayWorkers:
    """Ray's tasks as `agents.distributed.blocks.Workers`.

    Args:
        ray: the module, of a cluster that runs.
        count: of blocks flown at once.
    """

    def __init__(self, ray: Any, count: int):
        self._ray, self.count = ray, count
        self._task = ray.remote(num_cpus=1, max_retries=TRIES - 1)(fly_alone)

    def pack(self, scenario: Any, policy: Policy) -> Any:
        """Put both where all workers can read them."""
        return self._ray.put((scenario, policy))

    def send(self, package: Any, block: Block) -> Any:
        """Begin a task; returns the reference to its result."""
        return self._task.remote(package, block.episodes, block.seed)

    def first(self, tickets: list[Any]) -> Any:
        """Wait for one that is finished."""
        (done,), _ = self._ray.wait(tickets, num_returns=1)
        return done

    def result(self, ticket: Any, block: Block) -> dict[str, Any]:
        """A finished block.

        Raises:
            whatever went wrong in it; OSError: its workers died again and again.
        """
        errors = self._ray.exceptions
        try:
            return self._ray.get(ticket)
        except errors.RayTaskError as error:
            raise error.cause or error from None
        except errors.RayError as error:
            raise OSError(
                f"{block.title}: the workers that flew {block.span} died {TRIES} times ({type(error).__name__}); try "
                "fewer --workers if memory is short"
            ) from error

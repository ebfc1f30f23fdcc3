"""Evaluation in processes of this machine, one per core: what Python itself does then takes all cores too.

A policy is sent by cloudpickle, which knows functions made inside of others; it comes from this very process.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import cloudpickle

from agents.distributed.blocks import Block, fly_alone, fly_by
from agents.evaluation import Engine
from agents.policy import Policy
from trackers.compiled import available_cores


@contextmanager
def process_engine(workers: int | None = None) -> Iterator[Engine]:
    """An engine on processes, which are started with the first flight and ended with the engine.

    Args:
        workers: processes; None takes as many as this one may use cores.
    Raises:
        ValueError: less than one worker.
    """
    if workers is not None and workers < 1:
        raise ValueError(f"--workers {workers}: must be at least 1")
    count = workers or available_cores()
    # forked ones would inherit locks of threads that they do not have
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), initializer=_begin)
    try:
        yield lambda flights, bar: fly_by(ProcessWorkers(pool, count), flights, bar)
    finally:
        pool.shutdown(cancel_futures=True)


class ProcessWorkers:
    """Processes as `agents.distributed.blocks.Workers`.

    Args:
        pool: of processes; count: how many.
    """

    def __init__(self, pool: ProcessPoolExecutor, count: int):
        self._pool, self.count = pool, count

    def pack(self, scenario: Any, policy: Policy) -> bytes:
        """Both as bytes."""
        return cloudpickle.dumps((scenario, policy))

    def send(self, package: bytes, block: Block) -> Future[dict[str, Any]]:
        """Have a block flown by whoever is free.

        Raises:
            OSError: a process died.
        """
        try:
            return self._pool.submit(_fly_packed, package, block.episodes, block.seed)
        except BrokenProcessPool as error:
            raise _died(block) from error

    def first(self, tickets: list[Future[dict[str, Any]]]) -> Future[dict[str, Any]]:
        """Wait for one that is finished."""
        return next(iter(wait(tickets, return_when=FIRST_COMPLETED).done))

    def result(self, ticket: Future[dict[str, Any]], block: Block) -> dict[str, Any]:
        """A finished block.

        Raises:
            whatever went wrong in it; OSError: a process died.
        """
        try:
            return ticket.result()
        except BrokenProcessPool as error:
            raise _died(block) from error


def _died(block: Block) -> OSError:
    return OSError(
        f"{block.title}: a process died before {block.span} were flown; try fewer --workers if memory is short, or "
        "--engine local"
    )


def _begin() -> None:
    """Leave the other cores to the other processes."""
    import torch

    torch.set_num_threads(1)


def _fly_packed(package: bytes, episodes: int, seed: int) -> dict[str, Any]:
    return fly_alone(cloudpickle.loads(package), episodes, seed)

"""Work on several processes or machines by Ray, which is not needed for anything else: extra ``ray``."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from agents.evaluation import Engine, here


def engine_named(name: str, workers: int | None = None, address: str | None = None) -> AbstractContextManager[Engine]:
    """The engine ``local`` or ``ray`` for evaluations; entering it starts or finds the cluster.

    Raises:
        ValueError: workers or an address for the local one, or less than one worker.
    """
    if name == "ray":
        from agents.distributed.flying import ray_engine

        return ray_engine(workers, address)
    for flag, value in (("--workers", workers), ("--address", address)):
        if value is not None:
            raise ValueError(f"{flag} {value}: is for --engine ray only")
    return nullcontext(here)

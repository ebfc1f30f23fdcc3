"""Work on several processes or machines: this machine's cores, or Ray, which nothing else needs (extra ``ray``)."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from agents.evaluation import Engine, here


def engine_named(name: str, workers: int | None = None, address: str | None = None) -> AbstractContextManager[Engine]:
    """The engine ``local``, ``processes`` or ``ray`` for evaluations; entering it starts or finds the cluster.

    Raises:
        ValueError: workers for the local one, an address for any but Ray's, or less than one worker.
    """
    if name == "ray":
        from agents.distributed.flying import ray_engine

        return ray_engine(workers, address)
    if address is not None:
        raise ValueError(f"--address {address}: is for --engine ray only")
    if name == "processes":
        from agents.distributed.processes import process_engine

        return process_engine(workers)
    if workers is not None:
        raise ValueError(f"--workers {workers}: is for --engine processes and ray only")
    return nullcontext(here)

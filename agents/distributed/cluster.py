"""A Ray cluster for a while: one of its own on this machine, or one that runs already."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from passive_env.extras import needs

EXTRA = "ray"
CLUSTER = "start a cluster with 'ray start --head', or leave --address out"
ANSWER_S = 5.0
"""An address that has not answered after so long does not."""


def ray_module(name: str = "ray") -> Any:
    """A module that needs Ray.

    Raises:
        MissingExtra: Ray is not installed; names the command that installs it.
    """
    needs("ray" if name == "ray" else "ray.rllib", EXTRA)
    return import_module(name)


@contextmanager
def cluster(address: str | None, cores: int) -> Iterator[Any]:
    """Ray, connected; what was started here is stopped at the end, a cluster that ran before is left running.

    Args:
        address: HOST:PORT of a running cluster, or "auto" for the one on this machine; None starts one.
        cores: how many processes a new one may run at once.
    Yields:
        the module ``ray``.
    Raises:
        ImportError: Ray is not installed; ConnectionError: nothing answers at the address.
    """
    ray = ray_module()
    if address is not None:
        check_address(address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    settings = {"log_to_driver": False, "logging_level": "ERROR"}
    if address is None:  # Ray alone would join any cluster that it finds on the machine: "local" is a new one
        ray.init(address="local", num_cpus=cores, include_dashboard=False, **settings)
    else:
        _join(ray, address, settings)
    try:
        yield ray
    finally:
        ray.shutdown()


def _join(ray: Any, address: str, settings: dict[str, Any]) -> None:
    """Connect to a running cluster.

    Raises:
        ConnectionError: there is none.
    """
    try:
        ray.init(address=address, **settings)
    except (ConnectionError, RuntimeError) as error:
        raise ConnectionError(f"--address {address}: {str(error).splitlines()[0]}; {CLUSTER}") from error


def check_address(address: str) -> None:
    """Refuse an address at which nothing answers, before Ray tries for a minute.

    Raises:
        ValueError: no address; ConnectionError: nobody listens there.
    """
    if address == "auto":
        return
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and host and port.isdigit() and 0 < int(port) < 2**16):
        raise ValueError(f"--address {address}: must be HOST:PORT, such as 10.0.0.1:6379, or auto")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=ANSWER_S).close()
    except OSError as error:
        raise ConnectionError(f"--address {address}: nothing answers there ({error}); {CLUSTER}") from error

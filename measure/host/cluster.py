"""A dask cluster that somebody started, to hand work to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from measure.errors import ConfigError

_CONNECT_S = 10.0


@contextmanager
def connected(address: str, option: str) -> Iterator[tuple[Any, Any]]:
    """A client of a scheduler, and the module `distributed`.

    Args:
        address: of the scheduler.
        option: of the command line that gave it, for messages.

    Raises:
        ConfigError: the extra is missing, no scheduler answers, or it has no workers.
    """
    try:
        import distributed
    except ImportError:
        raise ConfigError(
            f"{option} needs dask.distributed: pip install 'triball[cluster]'"
        ) from None
    if "://" not in address:
        raise ConfigError(f"{option} {address}: expected a scheduler's address, tcp://HOST:PORT")
    try:
        client = distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(f"{option} {address}: no scheduler answers there ({reason})") from error
    try:
        if not client.scheduler_info().get("workers"):
            raise ConfigError(f"{option} {address}: the scheduler has no workers; start some")
        yield client, distributed
    finally:
        client.close()

"""Poses sent on as they are measured: one datagram each."""

from __future__ import annotations

import json
import math
import socket
from typing import Any, Self

from measure.errors import ConfigError
from measure.measuring import Measurement
from measure.results.tables import pose_row


class PoseSender:
    """Sends every measurement by UDP, as one JSON object; use it in a `with` block.

    Its members are the columns of `poses.parquet`, and `frame` for `index` as in `poses.csv`; null
    stands where there is no pose. Nobody need listen: what cannot be delivered is lost.
    """

    def __init__(self, address: tuple[str, int]) -> None:
        """Make one; ConfigError: there is no such host."""
        try:
            places = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError, OverflowError) as problem:
            reason = getattr(problem, "strerror", None) or problem
            raise ConfigError(f"cannot send to {address[0]}:{address[1]}: {reason}") from None
        # `localhost` is both 127.0.0.1 and ::1, and who listens at the one hears nothing of the
        # other: receivers of UDP listen by IPv4, unless they were given an address of IPv6.
        place = min(places, key=lambda place: place[0] != socket.AF_INET)
        family, kind, protocol, _, found = place
        self._address = found
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self, measured: Measurement, body: str | None = None) -> None:
        """Send one measurement; `body` names the body of a measurement of several."""
        try:
            self._socket.sendto(datagram(measured, body), self._address)
        except OSError:
            return  # nobody listens, or the network is down: the run itself goes on


def datagram(measured: Measurement, body: str | None = None) -> bytes:
    """A measurement as it is sent."""
    row = pose_row(measured)
    named = {} if body is None else {"body": body}
    values = {
        "frame": row.pop("index"),
        **named,
        **{name: _plain(value) for name, value in row.items()},
    }
    return json.dumps(values, allow_nan=False, separators=(",", ":")).encode()


def _plain(value: Any) -> Any:
    """What JSON knows; no digits that mean nothing."""
    if isinstance(value, float):
        return float(f"{value:.9f}") if math.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [float(f"{one:.6g}") if isinstance(one, float) else one for one in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return value

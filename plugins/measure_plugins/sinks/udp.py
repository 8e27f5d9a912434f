"""The sink `udp`: one datagram a pose, as JSON or OSC."""

from __future__ import annotations

import json
import socket
from typing import Any, Literal

from measure.errors import ConfigError
from measure.host import (
    EventMark,
    SentPose,
    Settings,
    Sink,
    hookimpl,
    host_port,
    needed,
    plain_names,
    setting,
)


class UdpSettings(Settings):
    """Settings of the `udp` sink."""

    format: Literal["json", "osc"] = setting("json", "What a datagram holds: json, or osc (OSC).")


class UdpSink(Sink):
    """Every pose as one datagram: a JSON object, or an OSC message.

    Nobody need listen: what cannot be delivered is lost.
    """

    name = "udp"
    form = "udp://HOST:PORT"
    Config = UdpSettings
    config: UdpSettings

    def prepare(self) -> None:
        """Read the address and load the libraries."""
        self._family, self._place = _place(*host_port(self.address, 5005))
        self._socket: socket.socket | None = None
        self._osc: Any = None
        self._words = plain_names(body.name for body in self.run.bodies)
        if self.config.format == "osc":
            self._osc = needed("pythonosc.osc_message_builder", "osc")

    def open(self) -> None:
        """Open the socket."""
        self._socket = socket.socket(self._family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send(self, pose: SentPose) -> None:
        """The columns of `poses.parquet`, and `frame` for `index`; null where there is no pose."""
        if self._osc is not None:
            return self._send_osc(pose)
        row = pose.plain()
        if len(self.run.bodies) < 2:
            del row["body"]
        if not pose.reference:
            del row["reference"]
        return self._send(json.dumps(row, allow_nan=False, separators=(",", ":")).encode())

    def send_mark(self, mark: EventMark) -> None:
        """What, and when on the run's clock."""
        if self._osc is not None:
            self._send(self._message("/triball/mark", mark.text, ("d", mark.time_s)))
        else:
            self._send(json.dumps({"mark": mark.text, "time_s": mark.time_s}).encode())

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _send(self, datagram: bytes) -> None:
        if self._socket is not None:
            self._socket.sendto(datagram, self._place)

    def _send_osc(self, pose: SentPose) -> None:
        """The pose in single precision, as every program of OSC reads it."""
        words = [self._words.get(one, one) for one in (pose.body, pose.reference) if one]
        path = "/".join(("/triball", *words))
        frame, time_s = pose.frame, ("d", pose.time_s)
        if pose.pose is None:
            self._send(self._message(f"{path}/lost", frame, time_s, pose.status, pose.reason))
        else:
            place = pose.pose.world_from_body
            sds = pose.pose.position_sd_mm, pose.pose.rotation_sd_deg
            numbers = map(float, (*place.translation, *place.quat_wxyz, *sds))
            self._send(self._message(f"{path}/pose", frame, time_s, *numbers, pose.status))

    def _message(self, path: str, *values: Any) -> bytes:
        """An OSC message; a value may be a pair of its type and itself."""
        message = self._osc.OscMessageBuilder(path)
        for value in values:
            kind, plain = value if isinstance(value, tuple) else (None, value)
            message.add_arg(plain, kind)
        return bytes(message.build().dgram)


def _place(host: str, port: int) -> tuple[int, Any]:
    """Family and address of a receiver; ConfigError: there is no such host."""
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError, OverflowError) as problem:
        reason = getattr(problem, "strerror", None) or problem
        raise ConfigError(f"cannot send to {host}:{port}: {reason}") from None
    # `localhost` is both 127.0.0.1 and ::1, and who listens at the one hears nothing of the
    # other: receivers of UDP listen by IPv4, unless they were given an address of IPv6.
    family, _, _, _, place = min(places, key=lambda one: one[0] != socket.AF_INET)
    return family, place


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `udp`."""
    return [UdpSink]

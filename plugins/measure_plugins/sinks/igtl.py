"""The sink `igtl`: a server of OpenIGTLink, which 3D Slicer and PLUS connect to."""

from __future__ import annotations

import re
import socket
import struct
from contextlib import suppress

from measure.errors import ConfigError
from measure.host import SentPose, Settings, Sink, hookimpl, host_port, needed, setting

_NOT_FOUND = 4  # The code of a STATUS that says what was asked for is not there


class IgtlSettings(Settings):
    """Settings of the `igtl` sink."""

    body: str = setting("", "Name of the body, of a run of one; empty: as in its file.")
    world: str = setting("Tracker", "Name of the world's frame, as in ToolToTracker.")


class IgtlSink(Sink):
    """TRANSFORM messages in mm for every program that connects, STATUS where there is no pose.

    A receiver that does not read loses its own poses.
    """

    name = "igtl"
    form = "igtl://HOST:PORT"
    Config = IgtlSettings
    config: IgtlSettings

    def prepare(self) -> None:
        """Read the address and load the libraries."""
        self._place = host_port(self.address)
        self._messages = needed("pyigtl.messages", "igtl")
        names = [self._device(*stream) for stream in self.run.streams]
        for name in names:
            if len(name) > 20 or names.count(name) > 1 or not name.isascii():
                wrong = f"'{name}' is no name of its own of at most 20 ASCII letters"
                raise ConfigError(f"{wrong}: give shorter ones with ?body= and &world=")
        self._server: socket.socket | None = None
        # With what a receiver has not taken of a message yet: it gets that before the next.
        self._clients: dict[socket.socket, bytes] = {}

    def open(self) -> None:
        """Listen."""
        family = socket.AF_INET6 if ":" in self._place[0] else socket.AF_INET
        self._server = socket.create_server(self._place, family=family)
        self._server.setblocking(False)

    def send(self, pose: SentPose) -> None:
        """One message to each receiver."""
        name = self._device(pose.body, pose.reference)
        if pose.pose is None:
            status = struct.pack(">Hq20s", _NOT_FOUND, 0, pose.status.encode())
            content = status + pose.reason.encode() + b"\0"
            message = self._messages.MessageBase(pose.exposed_s, name)
            vars(message).update(_message_type="STATUS", _pack_content=lambda: content)
        else:
            place = pose.pose.world_from_body.matrix
            message = self._messages.TransformMessage(place, pose.exposed_s, name)
        with suppress(BlockingIOError):
            while self._server is not None:
                client, _ = self._server.accept()
                client.setblocking(False)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._clients[client] = b""
        data = message.pack()
        took = [self._send_to(client, data) for client in list(self._clients)]
        self.undelivered += not all(took)

    def close(self) -> None:
        """Close all connections; what a receiver has not taken whole is lost to it."""
        self.undelivered += any(self._clients.values())
        for one in (*self._clients, *filter(None, [self._server])):
            one.close()
        self._clients, self._server = {}, None

    def _device(self, body: str, reference: str) -> str:
        """The name that PLUS would give it, such as ToolToReference."""
        names = self.config.body or body, reference or self.config.world
        words = (re.split(r"[\W_]+", name) for name in names)
        return "To".join("".join(w[:1].upper() + w[1:] for w in some) for some in words)

    def _send_to(self, client: socket.socket, data: bytes) -> bool:
        """Send what is left and then `data`; whether it is on its way."""
        try:
            with suppress(BlockingIOError):
                while client.recv(65_536):  # what it says is of no interest
                    pass
                raise ConnectionResetError
            # What is left goes first, and a message is begun only once nothing is.
            for part in (self._clients[client], data):
                self._clients[client] = part
                with suppress(BlockingIOError):
                    self._clients[client] = part[client.send(part) :]
                if self._clients[client]:
                    return part is data
        except OSError:
            del self._clients[client]
            client.close()
        return True


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `igtl`."""
    return [IgtlSink]

"""The sink `igtl`: a server of OpenIGTLink, which 3D Slicer and PLUS connect to."""

from __future__ import annotations

import re
import socket
import struct
import unicodedata
from contextlib import suppress

from measure.host import SentPose, Settings, Sink, hookimpl, host_port, needed, setting

_LETTERS, _FRAME_LETTERS = 20, 9  # Of a device name, and of the frame's share in it
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
        self._place = host_port(self.address, 18_944)
        self._messages = needed("pyigtl.messages", "igtl")
        self._names = self._device_names()
        self.notes = [
            f"{' in '.join(filter(None, stream))} is sent as {name}"
            for stream, name in self._names.items()
        ]
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
        name = self._names.get((pose.body, pose.reference), "")
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

    def _device_names(self) -> dict[tuple[str, str], str]:
        """For every stream the name that PLUS would give it, such as ToolToReference.

        OpenIGTLink leaves 20 letters of ASCII: accents are dropped and words run together; what is
        too long is cut, and of names that would be alike the later ones end in a number.
        """
        out: dict[tuple[str, str], str] = {}
        for body, reference in self.run.streams:
            frame = _word(reference or self.config.world)[:_FRAME_LETTERS] or "World"
            most = _LETTERS - len("To") - len(frame)
            word, number = (_word(self.config.body or body) or "Body"), 1
            name = f"{word[:most]}To{frame}"
            while name in out.values():
                number += 1
                name = f"{word[: most - len(str(number))]}{number}To{frame}"
            out[body, reference] = name
        return out

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


def _word(name: str) -> str:
    """A name as one word of ASCII letters and digits; empty where nothing of it is left."""
    plain = unicodedata.normalize("NFKD", name.replace("ß", "ss"))
    words = re.split(r"[^A-Za-z0-9]+", plain.encode("ascii", "ignore").decode())
    return "".join(word[:1].upper() + word[1:] for word in words)


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `igtl`."""
    return [IgtlSink]

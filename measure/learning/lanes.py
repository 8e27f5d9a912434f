"""The sockets of the estimator server: one for everybody, and one for each sender it knows."""

from __future__ import annotations

import selectors
import socket
import sys
from collections.abc import Iterator
from contextlib import suppress

from measure.errors import EstimatorError
from measure.learning.packets import LARGEST

Sender = tuple[str, int]  # Address and port

_BUFFER_BYTES = 4 << 20
_BATCH = 32  # Datagrams taken from the common socket before the lanes are looked at again
_MOST_QUEUED = 20_000  # Datagrams that the buffer of the common socket cannot exceed


class Lanes:
    """Receives datagrams, those of known senders first.

    Each known sender has a lane, a socket that is connected to it: the system puts its datagrams
    there and not into the common queue, where what strangers send, however much, could delay them
    or leave no room. Outside Linux, where sockets that share a port behave otherwise, all come by
    the common queue.
    """

    def __init__(self, address: Sender) -> None:
        """Listen; EstimatorError if it is impossible there."""
        self._common = _socket()
        try:
            self._common.bind(address)
        except (OSError, OverflowError) as problem:
            self._common.close()
            reason = getattr(problem, "strerror", None) or problem
            raise EstimatorError(
                f"cannot listen on udp://{address[0]}:{address[1]} ({reason}): choose another "
                "--port or --host"
            ) from None
        self._lanes: dict[Sender, socket.socket] = {}
        self._waiting: dict[Sender, int] = {}
        self._ready = selectors.DefaultSelector()
        self._ready.register(self._common, selectors.EVENT_READ)

    @property
    def address(self) -> Sender:
        """Where it listens."""
        host, port = self._common.getsockname()
        return str(host), int(port)

    def open(self, sender: Sender) -> None:
        """Give a sender a lane; it is used once what came before it has been read."""
        if sys.platform != "linux":
            return
        lane = _socket()
        try:
            # Only while it is bound: nobody else may share the port.
            for one in (self._common, lane):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            lane.bind(self._common.getsockname())
            lane.connect(sender)
        except OSError:  # its datagrams come by the common socket, as before
            lane.close()
            return
        finally:
            self._common.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        lane.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        self._lanes[sender], self._waiting[sender] = lane, _MOST_QUEUED

    def close_lane(self, sender: Sender) -> None:
        """A sender is known no more."""
        lane = self._lanes.pop(sender, None)
        if lane is None:
            return
        if self._waiting.pop(sender, None) is None:
            self._ready.unregister(lane)
        lane.close()

    def receive(self, timeout_s: float) -> Iterator[tuple[bytes, Sender]]:
        """Wait for datagrams; yield one of each lane, then some of the others."""
        ready = {key.fd for key, _ in self._ready.select(timeout_s)}
        for lane in list(self._lanes.values()):
            # One that was closed meanwhile, for its sender gave way, has no number any more.
            if lane.fileno() in ready and (received := _received(lane)) is not None:
                yield received
        if self._common.fileno() in ready:
            yield from self._common_ones()
        elif self._waiting:
            self._use(list(self._waiting))

    def send(self, data: bytes, sender: Sender) -> bool:
        """Send a datagram; whether that was possible."""
        try:
            self._common.sendto(data, sender)
        except OSError:  # a sender's port may be 0, its network down: the others still listen
            return False
        return True

    def close(self) -> None:
        """Stop listening."""
        for sender in list(self._lanes):
            self.close_lane(sender)
        self._ready.close()
        self._common.close()

    def _common_ones(self) -> Iterator[tuple[bytes, Sender]]:
        for _ in range(_BATCH):
            received = _received(self._common)
            if received is None:
                self._use(list(self._waiting))
                return
            yield received
        for sender in list(self._waiting):
            self._waiting[sender] -= _BATCH
            if self._waiting[sender] <= 0:
                self._use([sender])

    def _use(self, senders: list[Sender]) -> None:
        """Read their lanes from now on: what they sent before has been read."""
        for sender in senders:
            del self._waiting[sender]
            self._ready.register(self._lanes[sender], selectors.EVENT_READ)


def _socket() -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    out.setblocking(False)
    return out


def _received(place: socket.socket) -> tuple[bytes, Sender] | None:
    """A datagram, if one is there; an answer that could not be delivered is no reason to end."""
    with suppress(OSError):
        return place.recvfrom(LARGEST)
    return None

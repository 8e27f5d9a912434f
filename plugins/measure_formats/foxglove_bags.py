"""Pictures in MCAP files of the Foxglove SDK: `foxglove.CompressedImage` and `foxglove.RawImage`.

Their messages, protobuf or JSON, are given as those of ROS: a topic of either is read alike.
https://docs.foxglove.dev/docs/visualization/message-schemas
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from measure.bags import Bag, open_bag
from measure.errors import SessionError
from measure.processes import needed
from measure.reading import MCAP_START, check_ordinary

_KINDS = {
    "foxglove.CompressedImage": "sensor_msgs/msg/CompressedImage",
    "foxglove.RawImage": "sensor_msgs/msg/Image",
}
_FIELDS: Mapping[str, Mapping[int, str]] = {
    "sensor_msgs/msg/CompressedImage": {1: "timestamp", 2: "data", 3: "format"},
    "sensor_msgs/msg/Image": {
        1: "timestamp",
        2: "width",
        3: "height",
        4: "encoding",
        5: "step",
        6: "data",
    },
}
"""By number, of the schemas' protobuf."""
_TIME_FIELDS = {1: "sec", 2: "nsec"}
_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5  # Kinds of protobuf's fields


@dataclass(frozen=True)
class _Connection:
    """A topic, as `rosbags` has it."""

    topic: str
    msgtype: str  # of ROS
    is_json: bool


@contextmanager
def open_pictures(path: Path, where: str) -> Iterator[Bag]:
    """Open a bag of ROS, or an MCAP file of Foxglove as if it were one; SessionError as there."""
    if not _is_foxglove(path):
        with open_bag(path, SessionError, where) as bag:
            yield bag
        return
    check_ordinary(path, SessionError, where)
    reader = needed("mcap.reader", "ros", "reading MCAP files of Foxglove", SessionError)
    try:
        with path.open("rb") as file:
            yield Bag(path, _Reader(reader.make_reader(file)), "")
    except SessionError:
        raise
    except Exception as problem:  # its library raises many kinds; all mean the file
        reason = " ".join(str(problem).split()) or type(problem).__name__
        raise SessionError(f"{where}{path}: cannot be read as MCAP: {reason}") from None


def _is_foxglove(path: Path) -> bool:
    """Whether an MCAP file is not of ROS, which it says first."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(64)
    return head.startswith(MCAP_START) and b"ros" not in head[17:30]


class _Reader:
    """The topics of an MCAP file, read as those of ROS."""

    def __init__(self, mcap: Any) -> None:
        self._mcap, summary = mcap, mcap.get_summary()
        if summary is None:
            raise SessionError("its end is missing (the recording was cut off): `mcap recover`")
        self.connections = []
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            kind = "" if schema is None else schema.name
            is_json = channel.message_encoding == "json"
            known = _KINDS.get(kind, kind)
            self.connections.append(_Connection(channel.topic, known, is_json))

    def messages(
        self, connections: Sequence[_Connection], start: int | None = None
    ) -> Iterator[tuple[_Connection, int, bytes]]:
        by_topic = {connection.topic: connection for connection in connections}
        for _, channel, message in self._mcap.iter_messages([*by_topic], starting_at=start):
            connection = by_topic[channel.topic]
            mark = b"j" if connection.is_json else b"p"
            yield connection, message.log_time, mark + message.data

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """A message with the fields that ROS gives it."""
        try:
            return self._message(raw, kind)
        except (AttributeError, KeyError, IndexError, TypeError, ValueError, struct.error):
            raise SessionError(f"a message is damaged, or none of {', '.join(_KINDS)}") from None

    def _message(self, raw: bytes, kind: str) -> Any:
        if raw[:1] == b"j":
            metadata = json.loads(raw[1:])
            values = {name: metadata[name] for name in _FIELDS[kind].values()}
            values["data"] = base64.b64decode(values["data"])
            stamp = values["timestamp"]
        else:
            fields = _fields(memoryview(raw)[1:])
            values = {name: fields.get(number) for number, name in _FIELDS[kind].items()}
            packed = _fields(memoryview(values["timestamp"] or b""))
            stamp = {name: packed.get(number, 0) for number, name in _TIME_FIELDS.items()}
            for name in ("format", "encoding"):
                if name in values:
                    values[name] = bytes(values[name] or b"").decode()
        time = SimpleNamespace(sec=int(stamp.get("sec", 0)), nanosec=int(stamp.get("nsec", 0)))
        data = memoryview(values.pop("data") or b"")
        return SimpleNamespace(**values, data=data, header=SimpleNamespace(stamp=time))


def _fields(message: memoryview) -> dict[int, Any]:
    """The fields of a protobuf message by number; the last one where a number repeats."""
    at, out = 0, dict[int, Any]()
    value: Any
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
        elif kind == _BYTES:
            size, at = _varint(message, at)
            value, at = message[at : at + size], at + size
        elif kind in (_FOUR_BYTES, _EIGHT_BYTES):
            size = 4 if kind == _FOUR_BYTES else 8
            (value,) = struct.unpack("<I" if size == 4 else "<Q", message[at : at + size])
            at += size
        else:
            raise SessionError("a message is damaged")
        out[key >> 3] = value
    return out


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, and where it ends."""
    value = shift = 0
    while True:
        byte = message[at]
        value, shift, at = value | (byte & 0x7F) << shift, shift + 7, at + 1
        if byte < 0x80:
            return value, at

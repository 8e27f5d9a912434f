"""Topics of pictures in bags of ROS: each is a camera, at the stamps of its headers."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.bags import Bag, described, split_topic, stamp_ns
from measure.errors import SessionError
from measure.model import Image
from measure.session import Stream
from measure.session.pictures import (
    JPEG_START,
    decode_picture,
    held_bits,
    picture_form,
    picture_size_wh,
    refuse_huge,
)
from measure.session.timestamps import Stamps
from measure_formats.foxglove_bags import open_pictures
from measure_formats.ros_images import GREY, encoding_of, raw_pixels

_RAW, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


@dataclass(frozen=True, eq=False)
class _Index:
    """The pictures of a topic, by their stamps."""

    stamps_ns: Ints  # (n,) increasing
    places: Ints  # (n,) which message of the topic each is, in the order of their receipt
    received_ns: Ints  # (messages,) in that order
    notes: tuple[str, ...] = ()


class _Topic:
    """Gives a topic's messages by place, fastest in order; threads may share it."""

    def __init__(self, path: Path, topic: str | None, camera: str) -> None:
        self.path, self.where = path, f"camera '{camera}': "
        self._lock, self._open = threading.Lock(), ExitStack()
        self._messages: Iterator[Any] | None = None
        self._next = 0
        with open_pictures(path, self.where) as bag:
            self.name = _chosen(bag, topic, camera, self.where)
            self.first = self._first(bag)
            self.index = _indexed(bag, self.name, self.where)
            self.begins_ns = min(_first_stamps(bag))

    def _first(self, bag: Bag) -> Any:
        for connection, _, raw in bag.messages(_of(bag, self.name)):
            return bag.deserialize(raw, connection.msgtype)
        raise SessionError(f"{self.where}{self.path}: {self.name} holds no picture")

    def message(self, place: int) -> Any:
        """The message at a place."""
        with self._lock:
            if self._messages is None or place < self._next:
                self._restart(place)
            assert self._messages is not None
            for message in self._messages:
                self._next += 1
                if self._next > place:
                    return message
        raise SessionError(f"{self.where}{self.path}: has changed while it was read: try again")

    def _restart(self, place: int) -> None:
        self._close()
        bag = self._open.enter_context(open_pictures(self.path, self.where))
        received = self.index.received_ns
        self._next = int(np.searchsorted(received, received[place]))
        start_ns = int(received[place])

        def messages() -> Iterator[Any]:
            for connection, _, raw in bag.messages(_of(bag, self.name), start=start_ns):
                yield bag.deserialize(raw, connection.msgtype)

        self._messages = messages()

    def close(self) -> None:
        """Close the bag; reading again opens it again."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        self._messages = None
        self._open.close()


def _of(bag: Bag, topic: str) -> list[Any]:
    return [one for one in bag.connections if one.topic == topic]


def _pictures(bag: Bag) -> dict[str, str]:
    """Topics of pictures and their types."""
    kinds = {one.topic: one.msgtype for one in bag.connections}
    return {t: kinds[t] for t in sorted(kinds) if kinds[t] in (_RAW, _COMPRESSED)}


def _chosen(bag: Bag, topic: str | None, camera: str, where: str) -> str:
    """The topic that is named, or else the camera's, or the only one."""
    there = list(_pictures(bag))
    if not there:
        raise SessionError(
            f"{where}{bag.path}: a bag without pictures; it has {described(bag.connections)}"
        )
    fitting = there
    if topic is not None:
        fitting = [one for one in there if one.strip("/") == topic.strip("/")]
    elif len(there) > 1:
        fitting = [one for one in there if camera in one.split("/")]
    if len(fitting) == 1:
        return fitting[0]
    problem = f"no topic {topic} of pictures" if topic is not None else "several topics of pictures"
    raise SessionError(
        f"{where}{bag.path}: {problem}; there is {', '.join(there)}: name one, "
        f'as "{bag.path.name}#{there[0]}"'
    )


def _first_stamps(bag: Bag) -> Iterator[int]:
    for topic in _pictures(bag):
        for connection, received_ns, raw in bag.messages(_of(bag, topic)):
            yield stamp_ns(bag.deserialize(raw, connection.msgtype).header, received_ns)
            break


def _indexed(bag: Bag, topic: str, where: str) -> _Index:
    """Stamps of all pictures of a topic; the pictures themselves are passed over."""
    stamps, received, unstamped = list[int](), list[int](), 0
    for connection, received_ns, raw in bag.messages(_of(bag, topic)):
        header = bag.deserialize(raw, connection.msgtype).header
        unstamped += not (header.stamp.sec or header.stamp.nanosec)
        stamps.append(stamp_ns(header, received_ns))
        received.append(received_ns)
    if 0 < unstamped < len(stamps):
        raise SessionError(
            f"{where}{bag.path}: {topic}: {unstamped} of {len(stamps)} headers have no stamp: when "
            "those pictures were taken is not known; record what the camera's driver publishes"
        )
    times, places = np.unique(np.array(stamps), return_index=True)
    notes = [bag.cut_off] if bag.cut_off else []
    if unstamped:
        notes.append(f"{topic}: its headers have no stamps: times of receipt are taken")
    if repeats := len(stamps) - len(times):
        notes.append(
            f"{topic}: {repeats} of {len(stamps)} pictures repeat a stamp and are left out"
        )
    said = tuple(f"{where}{note}" for note in notes)
    return _Index(times, places.astype(np.int64), np.array(received), said)


class BagStream(Stream):
    """A topic of pictures.

    Attributes:
        begins_s: the first stamp of any picture in the bag.
    """

    def __init__(self, topic: _Topic, name: str, stamps: Stamps | None, offset_s: float) -> None:
        self._topic, index = topic, topic.index
        self._bits: int | None = None
        source, notes = f"{topic.path}#{topic.name}", list(index.notes)
        times_s: Floats = np.asarray(1e-9 * index.stamps_ns, dtype=np.float64)
        if stamps is not None:
            times_s = stamps.times_s
        self.begins_s = 1e-9 * topic.begins_ns
        size_wh, is_grey = self._form(topic.first, f"{topic.where}{source}")
        if is_grey:
            notes.append(
                f"{topic.where}{topic.name}: its pictures are grey, but balls are distinguished by "
                "colour"
            )
        frames = np.arange(len(times_s)) if stamps is None else stamps.frames
        path = topic.path
        files = sorted(f for f in path.iterdir() if f.is_file()) if path.is_dir() else [path]
        super().__init__(name, source, size_wh, frames, times_s + offset_s, files, tuple(notes))

    def _form(self, message: Any, where: str) -> tuple[tuple[int, int], bool]:
        """The size of pictures, and whether they are grey, by the first; refuses unknown kinds."""
        if hasattr(message, "encoding"):
            encoding = encoding_of(message, where)
            size_wh = int(message.width), int(message.height)
            refuse_huge(size_wh, where)
            return size_wh, encoding is GREY
        data = bytes(message.data)
        if picture_size_wh(data) is None or "compressedDepth" in str(message.format):
            raise SessionError(
                f"{where}: pictures are compressed as '{message.format}', which is not read: JPEG "
                "and PNG are"
            )
        size, largest = picture_form(data, where)
        self._bits = None if largest is None else held_bits(largest)
        return size, False

    def read(self, index: int) -> Image:
        """The picture at position `index`; of compressed ones with the recorded JPEG."""
        self.check_index(index)
        where = f"{self.place(index)}: {self.source}"
        message = self._topic.message(int(self._topic.index.places[index]))
        data = None if hasattr(message, "encoding") else bytes(message.data)

        def decode() -> Bytes:
            if data is None:
                pixels = raw_pixels(message, where)
            else:
                pixels = decode_picture(data, where, self._bits)
            if pixels.shape[1::-1] != self.size_wh:
                raise SessionError(
                    f"{where}: a picture of {pixels.shape[1]}x{pixels.shape[0]} px, the first is "
                    f"{self.size_wh[0]}x{self.size_wh[1]}"
                )
            return pixels

        is_jpeg = data is not None and data.startswith(JPEG_START)
        return self._image(index, decode, data if is_jpeg else None)

    def close(self) -> None:
        """Close the bag; reading again opens it again."""
        self._topic.close()


def open_bag_stream(
    name: str, address: Path, stamps: Stamps | None, stamps_path: Path | None, offset_s: float
) -> BagStream:
    """The pictures of a topic, `bag#topic`; see `open_video_stream`, which calls this.

    A bag alone stands for the topic with the camera's name between its slashes, or its only one.
    """
    path, topic = split_topic(address)
    found = _Topic(path, topic, name)
    count = len(found.index.stamps_ns)
    if stamps is not None and len(stamps.frames) != count:
        raise SessionError(
            f"camera '{name}': {address} has {count} pictures but {stamps_path} has "
            f"{len(stamps.frames)} rows; they must be equally many"
        )
    return BagStream(found, name, stamps, offset_s)

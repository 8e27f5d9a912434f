"""A video file: its frames in presentation order with the times the container gives them."""

from __future__ import annotations

import re
import threading
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from measure.arrays import Bytes, Floats
from measure.bags import is_bag, split_topic
from measure.errors import SessionError
from measure.limits import SINCE_1970_S
from measure.model import Image
from measure.neighbours import lacking
from measure.reading import check_ordinary
from measure.session.damage import refuse_truncated
from measure.session.formats import able
from measure.session.pictures import decode_picture, most_pixels, picture_size_wh, refuse_huge
from measure.session.streams import Stream, turned_notes
from measure.session.timestamps import Stamps

_HEAD_BYTES = 65536
_COUNTED_CONTAINERS = ("avi",)
"""These store no presentation time: the n-th picture shown gets the n-th time."""
_CONTAINERS = (
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,flv,asf,ogg,mxf,dv,nut,ivf,gif,apng,"
    "h264,hevc,m4v,mjpeg,mpegvideo,rawvideo"
)
"""What is opened. None of these names further files to be opened, as playlists do."""
_PATIENCE_S = 8.0  # Longest search for the next packet: damaged files may promise terabytes
_RAW_CONTAINERS = ("h264", "hevc", "m4v", "mjpeg", "mpegvideo", "rawvideo")
"""Bare streams without any time; a reader that gives some invents them."""


@dataclass(frozen=True, eq=False)
class VideoIndex:
    """Times and form of a video, without decoding."""

    stamps: list[int]  # presentation times in units of the time base, increasing, one per frame
    key_stamps: list[int]  # those of the frames that decode by themselves, increasing
    time_base: Fraction  # seconds a unit
    size_wh: tuple[int, int]  # width and height in px
    motion_jpeg: bool  # every packet is a JPEG
    counted: bool  # the container gives no presentation times; stamps belong to frames by order
    turned: bool  # a tag asks players to turn the pictures

    @property
    def times_s(self) -> Floats:
        """Presentation times (n,) in seconds after the first frame, exact to the time base.

        Containers begin at any time, for the order of decoding and by habit, so that the same
        frames would differ by up to seconds; only a time of day is kept.
        """
        first = 0 if self.stamps[0] * self.time_base > SINCE_1970_S else self.stamps[0]
        return np.array([float((stamp - first) * self.time_base) for stamp in self.stamps])


def index_video(path: Path, where: str) -> VideoIndex:
    """Read a video's packets, not its pictures; SessionError, from `where` on, if it is none."""
    if not check_ordinary(path, SessionError, where):
        raise SessionError(f"{where}{path}: the video is empty (0 bytes)")
    with _open(path, where) as container:
        stream = _video_of(container, path, where)
        packets = list(_packets(container, stream, path, where))
        name = container.format.name
        counted = any(kind in name for kind in _COUNTED_CONTAINERS)
        refuse_truncated(container, stream, packets, counted, path, where)
        packets = [packet for packet in packets if not packet[3]]
        if not packets:
            raise SessionError(f"{where}{path}: the video has no frames")
        timeless = any(kind in name.split(",") for kind in _RAW_CONTAINERS)
        times = [dts if counted else pts for pts, dts, _, _ in packets]
        if timeless or None in times:
            raise SessionError(
                f"{where}{path}: a bare {name} stream has no times; put it in an mp4 or mkv file"
            )
        stamps = sorted(times)
        keys = sorted(time for time, packet in zip(times, packets, strict=True) if packet[2])
        if len(set(stamps)) != len(stamps):
            raise SessionError(f"{where}{path}: two frames have the same time")
        context = stream.codec_context
        size = (int(context.width), int(context.height))
        refuse_huge(size, f"{where}{path}")
        motion_jpeg = context.name == "mjpeg"
        turned = _is_turned(path, where)
        return VideoIndex(stamps, keys, stream.time_base, size, motion_jpeg, counted, turned)


class VideoReader:
    """Gives an indexed video's frames by position, fastest in order; threads may share it."""

    def __init__(self, path: Path, index: VideoIndex) -> None:
        self.path = path
        self.index = index
        self._lock = threading.Lock()
        self._container: Any = None
        self._frames: Iterator[tuple[int, Any]] | None = None
        self._next = 0

    def picture(self, position: int, where: str) -> Bytes:
        """BGR pixels (h, w, 3) of the frame at `position`; SessionError if it cannot be decoded."""
        frame = self._advance(position, where, packets=False)
        # The default conversion repeats each chroma sample over two columns, which moves a coloured
        # edge by up to half a pixel depending on where it falls; this interpolates.
        return np.asarray(frame.to_ndarray(format="bgr24", interpolation=interpolation()))

    def jpeg(self, position: int, where: str) -> bytes:
        """The JPEG at `position` of a motion-JPEG video, as it was recorded."""
        return bytes(self._advance(position, where, packets=True))

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container = self._frames = None

    def _advance(self, position: int, where: str, packets: bool) -> Any:
        with self._lock:
            if self._frames is None or not self._reachable(position):
                self._seek(position, where, packets)
            try:
                item = self._found(position)
                if item is None and not self.index.counted:  # some containers seek beyond it
                    self._seek(0, where, packets)
                    item = self._found(position)
                if item is None:
                    raise SessionError("data missing")
            except Exception as problem:
                self._close()
                raise SessionError(
                    f"{where}{self.path}: the frame cannot be decoded ({_reason(problem)})"
                ) from None
            return item

    def _found(self, position: int) -> Any:
        """The frame or packet at a position, if it comes next or later; else None."""
        assert self._frames is not None
        target = self.index.stamps[position]
        for count, (stamp, item) in enumerate(self._frames, start=self._next):
            if count == position if self.index.counted else stamp == target:
                self._next = position + 1
                return item
            if not self.index.counted and stamp > target:
                break
        return None

    def _reachable(self, position: int) -> bool:
        """Whether decoding on is right: ahead of us, with no later frame to jump to."""
        if position <= self._next or self.index.counted:
            return position == self._next or (self.index.counted and position > self._next)
        return self._key_before(position) <= self.index.stamps[self._next]

    def _key_before(self, position: int) -> int:
        target = self.index.stamps[position]
        before = bisect_right(self.index.key_stamps, target)
        return self.index.key_stamps[before - 1] if before else self.index.stamps[0]

    def _seek(self, position: int, where: str, packets: bool) -> None:
        self._close()
        self._container = _open(self.path, where)
        stream = _video_of(self._container, self.path, where)
        stream.codec_context.options = {
            "err_detect": "explode",
            "max_pixels": f"{most_pixels():.0f}",
        }
        self._next = 0
        if position > 0 and not self.index.counted:
            self._container.seek(self._key_before(position), stream=stream, backward=True)
        self._frames = self._items(stream, packets)

    def _items(self, stream: Any, packets: bool) -> Iterator[tuple[int, Any]]:
        for packet in self._container.demux(stream):
            if packets:
                if packet.size:
                    yield packet.pts if not self.index.counted else packet.dts, packet
                continue
            for frame in packet.decode():
                if frame.is_corrupt:
                    raise SessionError("broken data")
                yield frame.pts, frame


def interpolation() -> int:
    """How colour is found between its samples, which are fewer than those of light."""
    from av.video.reformatter import Interpolation

    return int(Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND)


def _open(path: Path, where: str) -> Any:
    import av

    try:
        return av.open(str(path), options={"format_whitelist": _CONTAINERS}, timeout=_PATIENCE_S)
    except (av.error.FFmpegError, OSError) as problem:
        if path.is_file() and picture_size_wh(_head(path)):
            text = "is a picture: name pictures by the key images, not video"
            raise SessionError(f"{where}{path} {text}") from None
        raise SessionError(
            f"{where}{path}: not a video that can be read, or its recording was cut off "
            f"({_reason(problem)}): copy it again from where it was recorded, or record it anew"
        ) from None


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)


def _is_turned(path: Path, where: str) -> bool:
    """Whether the first frame bears a rotation; False where it does not decode."""
    try:
        with _open(path, where) as container:
            return any(frame.rotation for frame in islice(container.decode(video=0), 1))
    except Exception:  # reading that frame will say so
        return False


def _reason(problem: BaseException) -> str:
    text = getattr(problem, "strerror", None) or str(problem)
    return text[:1].lower() + text[1:].rstrip(".")


def _video_of(container: Any, path: Path, where: str) -> Any:
    if not container.streams.video:
        raise SessionError(f"{where}{path}: the file holds no video, or was cut off")
    return container.streams.video[0]


def _packets(
    container: Any, stream: Any, path: Path, where: str
) -> Iterator[tuple[Any, Any, bool, bool]]:
    try:
        for packet in container.demux(stream):
            if packet.is_corrupt:
                raise SessionError("broken data")
            if packet.size:
                yield packet.pts, packet.dts, packet.is_keyframe, packet.is_discard
    except Exception as problem:
        raise SessionError(
            f"{where}{path}: the video is cut off or damaged ({_reason(problem)})"
        ) from None


_CHAPTER = re.compile(r"(?P<kind>G[HXLS])(?P<chapter>[0-9]{2})(?P<video>[0-9]{4})", re.IGNORECASE)
_OLD_CHAPTER = re.compile(r"(?P<kind>GP)(?P<chapter>[0-9]{2})(?P<video>[0-9]{4})", re.IGNORECASE)
_OLD_FIRST = re.compile(r"GOPR(?P<video>[0-9]{4})", re.IGNORECASE)


def chapters(path: Path) -> list[Path]:
    """The files of an action camera's recording that begins with this one, in order.

    GoPro's cameras begin a new file every few minutes: GH010001.MP4, GH020001.MP4 (or GX, GL,
    GS), or GOPR0001.MP4, GP010001.MP4. Of any other file it is that alone. SessionError: a
    chapter in between is missing.
    """
    first, pattern, number = _CHAPTER.fullmatch(path.stem), _CHAPTER, 1
    if first is None:
        first, pattern, number = _OLD_FIRST.fullmatch(path.stem), _OLD_CHAPTER, 0
    if first is None or int(first.groupdict().get("chapter", "0")) != number:
        return [path]
    kind = first.groupdict().get("kind", "GP").upper()
    later = {number: path}
    for file in path.parent.iterdir():
        found = pattern.fullmatch(file.stem)
        if found and file.suffix.lower() == path.suffix.lower():
            same = found["kind"].upper() == kind and found["video"] == first["video"]
            if same and int(found["chapter"]) > number:
                later[int(found["chapter"])] = file
    if missing := sorted(set(range(number, max(later) + 1)) - set(later)):
        raise SessionError(
            f"{path}: has {len(later)} chapters, up to {later[max(later)].name}, and chapter "
            f"{missing[0]:02d} in between is missing: copy it from the camera"
        )
    return [later[k] for k in sorted(later)]


def _joined_times_s(indices: Sequence[VideoIndex]) -> Floats:
    """Times of videos that follow each other without a pause."""
    times_s, begin = list[Floats](), 0.0
    for index in indices:
        own = index.times_s
        times_s.append(own if own[0] > SINCE_1970_S else begin + own)
        begin += float(own[-1] + np.median(np.diff(own))) if len(own) > 1 else 0.0
    return np.concatenate(times_s)


class VideoStream(Stream):
    """A video: its own presentation times, or stamps from a file beside it.

    Of an action camera all chapters, one after the other.

    Attributes:
        begins_s: the time at which it begins, where its container counts from 1970; else 0.
    """

    def __init__(
        self, name: str, parts: Mapping[Path, VideoIndex], stamps: Stamps, offset_s: float
    ) -> None:
        (path, *more), (index, *others) = parts.keys(), parts.values()
        times_s, notes = stamps.times_s + offset_s, turned_notes(name, index.turned)
        if more:
            files = ", ".join(file.name for file in parts)
            notes = (*notes, f"camera '{name}': {len(parts)} chapters are joined: {files}")
        for file, other in zip(more, others, strict=True):
            if other.size_wh != index.size_wh:
                raise SessionError(
                    f"camera '{name}': {file} has {other.size_wh[0]}x{other.size_wh[1]} px, "
                    f"{path.name} {index.size_wh[0]}x{index.size_wh[1]}"
                )
        super().__init__(name, str(path), index.size_wh, stamps.frames, times_s, [*parts], notes)
        self.begins_s = float(times_s[0]) if times_s[0] > SINCE_1970_S else 0.0
        self._readers = [VideoReader(file, one) for file, one in parts.items()]
        self._ends = np.cumsum([len(one.stamps) for one in parts.values()])
        self._motion_jpeg = index.motion_jpeg

    def read(self, index: int) -> Image:
        """The frame at position `index`; of a motion-JPEG video with the recorded JPEG."""
        self.check_index(index)
        where = f"{self.place(index)}: "
        chapter = int(np.searchsorted(self._ends, index, side="right"))
        reader, position = self._readers[chapter], index - int(self._ends[chapter])
        position += len(reader.index.stamps)
        data = reader.jpeg(position, where) if self._motion_jpeg else None

        def decode() -> Bytes:
            if data is None:
                return reader.picture(position, where)
            return decode_picture(data, f"{where}{self.source}")

        return self._image(index, decode, data)

    def close(self) -> None:
        """Close the files; reading again opens them again."""
        for reader in self._readers:
            reader.close()


def open_video_stream(
    name: str,
    path: Path,
    stamps: Stamps | None = None,
    stamps_path: Path | None = None,
    offset_s: float = 0.0,
) -> Stream:
    """Open a video (mp4, mkv, avi, ...; H.264, motion JPEG, ...), or a topic in a bag of ROS.

    Without `stamps`, from the file `stamps_path`, times are the container's own after the first
    frame, or those of the topic's headers. SessionError: missing, empty, truncated or damaged, or
    `stamps` has not one row a frame.
    """
    if is_bag(split_topic(path)[0]):
        for open_pictures in able("open_pictures").values():
            return cast("Stream", open_pictures(name, path, stamps, stamps_path, offset_s))
        raise lacking("reading bags of ROS", "measure_formats")
    where = f"camera '{name}': "
    check_ordinary(path, SessionError, where)
    parts = {file: index_video(file, where) for file in chapters(path)}
    count = sum(len(index.stamps) for index in parts.values())
    if stamps is None:
        stamps = Stamps(np.arange(count), _joined_times_s([*parts.values()]))
    elif len(stamps.frames) != count:
        raise SessionError(
            f"camera '{name}': {path} has {count} frames but {stamps_path} has "
            f"{len(stamps.frames)} rows; they must be equally many"
        )
    return VideoStream(name, parts, stamps, offset_s)

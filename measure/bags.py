"""Bags of ROS 1 and ROS 2, read without ROS; of one that was cut off, what is whole."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from measure.errors import MeasureError
from measure.processes import needed
from measure.reading import MCAP_START, check_ordinary, kind_by_content, missing_message

_FOOTER = struct.pack("<BQQQL", 0x02, 20, 0, 0, 0) + MCAP_START
"""Of an MCAP file without a summary: https://mcap.dev/spec."""
BAGS = ".mcap", ".bag", ".db3"
"""How the names of bags end, by which `rosbags` knows them."""
_CHUNK, _DATA_END = 0x06, 0x0F
_LARGEST_CHUNK_BYTES = 1 << 28
_MAX_YAML_BYTES = 8 << 20  # metadata.yaml is read whole, where the rest of a bag is not
_CUT_OFF = "its end is missing (the recording was cut off): what is whole is read"
_UNLISTED = "has no metadata.yaml (the recording was cut off): its files are read as they are"


def is_bag(path: Path) -> bool:
    """Whether a file or folder is a bag, by its content."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(_storage(path))
    return path.is_file() and kind_by_content(path) in BAGS


def split_topic(address: Path | str) -> tuple[Path, str | None]:
    """A path and the topic after its `#`, if any: `bag.mcap#/cam0/image_raw`."""
    path = Path(address)
    if path.exists():
        return path, None
    before, hash_sign, topic = str(address).partition("#")
    return (Path(before), topic) if hash_sign else (path, None)


def _storage(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag's folder, in the order of their recording."""
    files = [file for file in folder.iterdir() if file.suffix in (".mcap", ".db3")]
    return sorted(files, key=lambda file: [int(n) for n in re.findall(r"[0-9]+", file.stem)][-1:])


class Bag:
    """An open bag, read as `rosbags` reads one; what comes before damage is read."""

    def __init__(self, path: Path, reader: Any, cut_off: str) -> None:
        self.path, self._reader = path, reader
        self.connections: list[Any] = reader.connections
        self.cut_off = cut_off  # what to say of one whose end is missing; empty of a whole one

    def messages(
        self, connections: Sequence[Any], start: int | None = None
    ) -> Iterator[tuple[Any, int, bytes]]:
        """Connection, time of receipt in ns and raw bytes of messages, as they were received."""
        count = 0
        try:
            for message in self._reader.messages(connections, start=start):
                count += 1
                yield message
        except Exception:  # rosbags and its databases raise many kinds; all mean the file
            if not count:
                raise
            self.cut_off = f"{self.path}: {_CUT_OFF}"

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """A message."""
        return self._reader.deserialize(raw, kind)


def described(connections: Sequence[Any]) -> str:
    """A bag's topics and their types."""
    kinds = {c.topic: c.msgtype.replace("/msg/", "/") for c in connections}
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(kinds.items())) or "no topic"


def stamp_ns(header: Any, received_ns: int) -> int:
    """When a message was made; when it was recorded, if it does not say."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec) or int(received_ns)


@contextmanager
def open_bag(
    path: Path,
    error: type[MeasureError],
    where: str = "",
    register: Callable[[Any, Any], None] = lambda _store, _typesys: None,
) -> Iterator[Bag]:
    """Open a bag: a file of ROS 1, MCAP or SQLite, or the folder of a ROS 2 bag.

    Args:
        where: begin of messages.
        register: adds types to the store of those that a bag may lack, given `rosbags.typesys`.

    Raises:
        error: missing, no bag, or broken, here or while it is read.
    """
    typesys = _rosbags("typesys", error)
    try:
        files, cut_off = _files(path, error, where)
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)  # bags of ROS 1 bring their own
        register(store, typesys)
        with _rosbags("highlevel", error).AnyReader(files, default_typestore=store) as reader:
            yield Bag(path, reader, cut_off)
    except MeasureError:
        raise
    except Exception as problem:  # rosbags raises many kinds; all mean the file
        reason = " ".join(str(problem).split()) or type(problem).__name__
        what = f"{where}{path}: cannot be read as a bag"
        raise error(f"{what}: {reason}{_hint(path, reason)}") from None


def _rosbags(part: str, error: type[MeasureError]) -> Any:
    return needed(f"rosbags.{part}", "ros", "reading bags", error)


def _hint(path: Path, reason: str) -> str:
    """What mends a bag."""
    if "not indexed" in reason or "index looks damaged" in reason:
        return ": `rosbag reindex` mends a bag of ROS 1 that was cut off"
    if "malformed" in reason or "disk image" in reason:
        return (
            ": was the recording cut off? `sqlite3 OLD .recover | sqlite3 NEW` saves what is whole"
        )
    return ": give the bag's folder" if path.suffix == ".db3" else ""


def _files(path: Path, error: type[MeasureError], where: str) -> tuple[list[Any], str]:
    """What rosbags is to open, and what to say of what is missing."""
    if not path.exists():
        raise error(where + missing_message(path))
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if not file.is_dir():  # A pipe in the bag's folder would be waited for
            check_ordinary(file, error, where, _MAX_YAML_BYTES if file.suffix == ".yaml" else None)
    parts = _storage(path) if path.is_dir() else [path]
    torn = [file for file in parts if _is_torn(file)]
    is_listed = path.is_dir() and (path / "metadata.yaml").is_file()
    if not parts or (not torn and (is_listed or not path.is_dir())):
        return [path], ""
    storage = _rosbags("rosbag2.storage_mcap", error)
    files = [_Torn(file, storage) if file in torn else file for file in parts]
    return files, f"{path}: {_CUT_OFF if torn else _UNLISTED}"


def _is_torn(path: Path) -> bool:
    """Whether an MCAP file lacks its end."""
    if kind_by_content(path) != ".mcap":
        return False
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - len(MCAP_START), len(MCAP_START)))
        return file.read() != MCAP_START


class _Torn:
    """An MCAP file without its end, as `rosbags` opens paths: what is whole, and an end."""

    def __init__(self, path: Path, storage: Any) -> None:
        self._path, self._storage = path, storage
        self.suffix, self.stem, self.name = path.suffix, path.stem, path.name

    def __str__(self) -> str:
        return str(self._path)

    def exists(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def open(self, *_: Any, **__: Any) -> Any:
        """The whole records, those in the chunk that was being written, and a footer."""
        file = self._path.open("rb")
        end, rest = _whole_records(file, self._path.stat().st_size)
        inner = _in_chunk(rest, self._storage) if rest else b""
        return io.BufferedReader(_Spliced(file, end, inner + _FOOTER))


def _whole_records(file: Any, size: int) -> tuple[int, bytes]:
    """Where the last whole record ends; what there is of the contents of a chunk after it."""
    at = len(MCAP_START)
    while at + 9 <= size:
        file.seek(at)
        kind, length = struct.unpack("<BQ", file.read(9))
        if kind in (0, _DATA_END):  # zeros of a power cut, or the summary has begun
            break
        if at + 9 + length > size:
            return at, file.read(_LARGEST_CHUNK_BYTES) if kind == _CHUNK else b""
        at += 9 + length
    return at, b""


def _in_chunk(chunk: bytes, storage: Any) -> bytes:
    """The whole records in what there is of a chunk, as they stand outside of one."""
    text_bytes = int.from_bytes(chunk[28:32], "little")
    compression, data = chunk[32 : 32 + text_bytes], chunk[40 + text_bytes :]
    try:
        if compression == b"zstd":
            data = storage.zstd.ZstdDecompressor().decompress(data, _LARGEST_CHUNK_BYTES)
        elif compression == b"lz4":
            lz4 = needed("lz4.frame", "ros", "reading bags")
            data = lz4.LZ4FrameDecompressor().decompress(data, _LARGEST_CHUNK_BYTES)
    except Exception:  # each compressor has kinds of its own
        return b""
    at = 0
    while at + 9 <= len(data):
        (length,) = struct.unpack("<Q", data[at + 1 : at + 9])
        if at + 9 + length > len(data):
            break
        at += 9 + length
    return bytes(data[:at])


class _Spliced(io.RawIOBase):
    """A file up to a place, and other bytes from there on."""

    def __init__(self, file: Any, end: int, tail: bytes) -> None:
        super().__init__()
        self._file, self._end, self._tail, self._at = file, end, tail, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        size = self._end + len(self._tail)
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: size}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._end:
            self._file.seek(self._at)
            data = self._file.read(min(len(buffer), self._end - self._at))
        else:
            start = self._at - self._end
            data = self._tail[start : start + len(buffer)]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()

"""One camera's recording, whatever it is kept in; and numbered picture files."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from measure.arrays import Bytes, Floats, Ints
from measure.errors import SessionError
from measure.model import Image
from measure.reading import missing_message
from measure.session import pictures
from measure.session.files import matching_files
from measure.session.timestamps import StampErrors, Stamps, stamps_in_names


class Stream(ABC):
    """The frames of one camera, in the order of their times.

    Attributes:
        source: the folder, glob or video file, for messages.
        size_wh: width and height of its images in px.
        frames: (n,) frame numbers.
        times_s: (n,) middles of the exposures on the session's clock, increasing.
        stamps: how wrong the times are, as far as they show it.
        notes: what a user should know: missing frames and the like.
        begins_s: the time at which it begins, where its file counts from 1970; else 0.
    """

    begins_s = 0.0

    def __init__(
        self,
        name: str,
        source: str,
        size_wh: tuple[int, int],
        frames: Ints,
        times_s: Floats,
        files: Sequence[Path],
        notes: tuple[str, ...] = (),
    ) -> None:
        self.name = name
        self.source = source
        self.size_wh = size_wh
        self.frames = frames
        self.times_s = times_s
        self.files = list(files)
        self.stamps = StampErrors.of(times_s)
        self.notes = notes

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def period_s(self) -> float:
        """Median time between frames; infinite for a single one."""
        return float(np.median(np.diff(self.times_s))) if len(self) > 1 else float("inf")

    @abstractmethod
    def read(self, index: int) -> Image:
        """The frame at position `index`, decoded on first use; SessionError says which it is."""

    def repeated(self) -> Ints | None:
        """Positions of pictures equal to the one before; None where only decoding would show it."""
        return None

    def close(self) -> None:  # noqa: B027 -- most streams hold nothing open
        """Let go of open files."""

    def _image(self, index: int, decode: Callable[[], Bytes], encoded: bytes | None) -> Image:
        frame, time_s = int(self.frames[index]), float(self.times_s[index])
        return Image(self.name, frame, time_s, decode, encoded, float(self.stamps.sd_s[index]))

    def place(self, index: int) -> str:
        """Camera and frame, for messages."""
        return f"camera '{self.name}', frame {self.frames[index]}"

    def file_name(self, index: int) -> str:
        """The name of the file that holds a frame, and which of its frames if there are several."""
        if len(self.files) == len(self):
            return self.files[index].name
        return f"frame {self.frames[index]} of {Path(self.source).name}"

    def check_index(self, index: int) -> None:
        """Refuse a position outside the recording."""
        if not 0 <= index < len(self):
            raise SessionError(
                f"camera '{self.name}': there is no frame at position {index}; "
                f"{self.source} has {len(self)}"
            )


class ArrayStream(Stream):
    """Pictures that are there already, as arrays.

    Args:
        pictures: n of them, (h, w, 3) uint8, BGR, of one size.
        times_s: (n,) middles of the exposures, increasing.
    """

    def __init__(self, name: str, pictures: Sequence[Bytes], times_s: Floats) -> None:
        self._pictures, times_s = pictures, np.asarray(times_s, dtype=np.float64)
        if not len(pictures) or times_s.shape != (len(pictures),):
            raise SessionError(
                f"camera '{name}': {len(pictures)} pictures and times of shape {times_s.shape}: "
                "expected one time for each picture"
            )
        if not np.all(np.diff(times_s) > 0) or not np.all(np.isfinite(times_s)):
            raise SessionError(f"camera '{name}': its times must be finite and increase")
        first = pictures[0]
        if first.ndim != 3 or first.shape[2] != 3 or first.dtype != np.uint8:
            raise SessionError(
                f"camera '{name}': a picture is {first.dtype} of shape {first.shape}: expected "
                "uint8 of shape (h, w, 3), BGR"
            )
        height, width = first.shape[:2]
        super().__init__(name, "arrays", (width, height), np.arange(len(pictures)), times_s, [])

    def read(self, index: int) -> Image:
        """The picture at position `index`."""
        self.check_index(index)
        pixels = self._pictures[index]
        if pixels.shape != (*self.size_wh[::-1], 3) or pixels.dtype != np.uint8:
            raise SessionError(
                f"{self.place(index)} is {pixels.dtype} of shape {pixels.shape}, unlike the first"
            )
        return self._image(index, lambda: pixels, None)


class AlteredStream(Stream):
    """Some of the pictures of a stream, or all of them put right: its files stay as they are.

    Args:
        whole: the stream.
        positions: (n,) of the pictures that are used, increasing.
        change: what is done to the pixels (h, w, 3) of each, if anything.
    """

    def __init__(
        self, whole: Stream, positions: Ints, change: Callable[[Bytes], Bytes] | None = None
    ) -> None:
        self.whole = whole
        self.positions = positions
        self._change = change
        one_a_picture = len(whole.files) == len(whole)
        files = [whole.files[k] for k in positions] if one_a_picture else whole.files
        frames, times_s = whole.frames[positions], whole.times_s[positions]
        size_wh, notes = whole.size_wh, whole.notes
        super().__init__(whole.name, whole.source, size_wh, frames, times_s, files, notes)
        self.begins_s = whole.begins_s

    def read(self, index: int) -> Image:
        """The frame at position `index` of those that are used."""
        self.check_index(index)
        image, change = self.whole.read(int(self.positions[index])), self._change
        if change is None:
            return self._image(index, image.decode, image.encoded)
        return self._image(index, lambda: np.ascontiguousarray(change(image.decode())), None)

    def repeated(self) -> Ints | None:
        """Positions of pictures equal to the one before, which is used as well."""
        again = self.whole.repeated()
        if again is None:
            return None
        follows = np.diff(self.positions, prepend=-2) == 1
        return np.flatnonzero(np.isin(self.positions, again) & follows)

    def close(self) -> None:
        """Close the files of the whole stream."""
        self.whole.close()


def turned_notes(name: str, turned: bool) -> tuple[str, ...]:
    """What to say of a camera whose pictures bear a tag that asks to turn them, if they do."""
    text = (
        f"camera '{name}': an orientation tag asks to turn its pictures; they are measured as "
        "stored: calibrate stored ones (measure calibrate does; OpenCV turns what it reads)"
    )
    return (text,) if turned else ()


_PROBED = 8
"""Pictures of 16 bits, spread over a recording, whose largest value tells the camera's bits."""


class ImageStream(Stream):
    """Picture files, one per frame."""

    def __init__(
        self,
        name: str,
        source: str,
        files: list[Path],
        frames: Ints,
        times_s: Floats,
        notes: tuple[str, ...] = (),
        bits: int | None = None,
    ) -> None:
        size_wh, largest = _form(name, files[0])
        notes = (*notes, *turned_notes(name, pictures.is_turned(pictures.picture_bytes(files[0]))))
        if largest is not None and bits is None:
            some = files[:: -(-len(files) // _PROBED)]
            largest = max(_form(name, file)[1] or 0 for file in some)
            bits = pictures.held_bits(largest)
            held = f"camera '{name}': its pictures of 16 bits hold {bits} (values up to {largest})"
            notes = (*notes, f"{held}; if not, state bit_depth for it in session.toml")
        self._bits = bits
        super().__init__(name, source, size_wh, frames, times_s, files, notes)

    def read(self, index: int) -> Image:
        """The frame at position `index`: the file is read now, the pixels decode on first use."""
        self.check_index(index)
        where = f"{self.place(index)}: "
        data = self._content(index)

        def decode() -> Bytes:
            pixels = pictures.decode_picture(data, f"{where}{self.files[index]}", self._bits)
            if pixels.shape[1::-1] != self.size_wh:
                raise SessionError(
                    f"{where}{self.files[index]} is {pixels.shape[1]}x{pixels.shape[0]} px, "
                    f"the first image {self.size_wh[0]}x{self.size_wh[1]}"
                )
            return pixels

        return self._image(index, decode, data if data.startswith(pictures.JPEG_START) else None)

    def repeated(self) -> Ints | None:
        """Positions of files with the content of the one before; most differ in size already."""
        sizes = [file.stat().st_size for file in self.files]
        alike = [k for k in range(1, len(sizes)) if sizes[k] == sizes[k - 1]]
        return np.array([k for k in alike if self._content(k) == self._content(k - 1)], np.int64)

    def _content(self, index: int) -> bytes:
        return pictures.picture_bytes(self.files[index], f"{self.place(index)}: ")


def open_image_stream(
    name: str,
    folder: Path,
    pattern: str,
    stamps: Stamps | None,
    stamps_path: Path | None,
    offset_s: float,
    bits: int | None = None,
) -> ImageStream:
    """The files that fit `pattern` in `folder`, matched with their stamps.

    Without stamps their names must hold them (see `stamps_in_names`).

    The last number in a file's name is its frame number; if that is not unique (the camera's comes
    last), one that is and that the stamps have. Where names carry no such number,
    files and rows are matched in order, 2 before 10, and must be equally many.

    Raises:
        SessionError: no file fits, a file is empty, or files and rows do not belong together.
    """
    files = _find(name, folder, pattern)
    source = str(folder / pattern)
    for file in files:
        if file.stat().st_size == 0:
            raise SessionError(f"camera '{name}': {file}: the file is empty (0 bytes)")
    if stamps is None or stamps_path is None:
        stamps, stamps_path = stamps_in_names([file.name for file in files]), folder / pattern
        if stamps is None:
            raise SessionError(
                f"camera '{name}': images carry no time; give timestamps = \"....csv\", or name "
                f"the pictures by their stamps, in ns, say ({files[0].name} holds none)"
            )
    numbers = numbers_in(files, stamps.frames)
    if stamps.names:
        files, numbers = _named(name, source, files, stamps_path, stamps)
    if None in numbers or len(set(numbers)) != len(files):
        if len(files) != len(stamps.frames):
            odd = next((f.name for f, n in zip(files, numbers, strict=True) if n is None), "")
            raise SessionError(_count_message(name, source, len(files), stamps_path, stamps, odd))
        times_s = stamps.times_s + offset_s
        return ImageStream(name, source, files, stamps.frames, times_s, bits=bits)
    by_number = dict(zip(numbers, files, strict=True))
    _refuse_unstamped(name, source, by_number, stamps_path, stamps)
    present = np.array([int(frame) in by_number for frame in stamps.frames])
    gone = stamps.frames[~present]
    lost = f"camera '{name}': {len(gone)} of {len(present)} frames have no image in {source}"
    notes = (f"{lost} (frame {_some(gone)})",) if len(gone) else ()
    frames = stamps.frames[present]
    ordered = [by_number[int(frame)] for frame in frames]
    times_s = stamps.times_s[present] + offset_s
    return ImageStream(name, source, ordered, frames, times_s, notes, bits)


def _form(name: str, file: Path) -> tuple[tuple[int, int], int | None]:
    where = f"camera '{name}': "
    if _is_video(file):
        raise SessionError(f"{where}{file} is a video: name it by the key video, not images")
    return pictures.picture_form(pictures.picture_bytes(file, where), f"{where}{file}")


def _is_video(file: Path) -> bool:
    with suppress(OSError), file.open("rb") as opened:
        head = opened.read(12)
        return head[4:8] == b"ftyp" or head[:4] == b"\x1aE\xdf\xa3" or head[8:] == b"AVI "
    return False


def _find(name: str, folder: Path, pattern: str) -> list[Path]:
    files = matching_files(folder, pattern, SessionError)
    if files:
        return files
    place = (folder / pattern).parent
    if any(sign in str(place) for sign in "*?["):
        raise SessionError(f"camera '{name}': no image fits {folder / pattern}")
    if not place.is_dir():
        raise SessionError(f"camera '{name}': {missing_message(place)}")
    try:
        here = [file for file in place.iterdir() if file.is_file()]
    except OSError as problem:
        raise SessionError(
            f"camera '{name}': {place}: cannot be read: {problem.strerror}"
        ) from None
    kinds = sorted({f"*{file.suffix}" for file in here})
    hint = f": try {' or '.join(kinds)}" if kinds else ""
    raise SessionError(
        f"camera '{name}': no image fits {folder / pattern}; the folder has {len(here)} files{hint}"
    )


def numbers_in(files: Sequence[Path], frames: Ints) -> list[int | None]:
    """The frame number, of `frames`, in each file's name; else its last number, if it has any."""
    found = [[int(number) for number in re.findall(r"[0-9]+", file.stem)] for file in files]
    last = [numbers[-1] if numbers else None for numbers in found]
    if len(set(last)) == len(last) or len(set(map(len, found))) > 1:
        return last
    known = set(frames.tolist())
    for numbers in reversed(list(zip(*found, strict=True))):
        if len(set(numbers)) == len(numbers) and known.issuperset(numbers):
            return list(numbers)
    return last


def _named(
    name: str, source: str, files: list[Path], path: Path, stamps: Stamps
) -> tuple[list[Path], list[int | None]]:
    """The files that stamps name, and the frames that they are; refuses files without a stamp."""
    frames = {Path(n).name: int(f) for n, f in zip(stamps.names, stamps.frames, strict=True)}
    frames |= {Path(n).stem: f for n, f in frames.items()}
    found = [frames.get(file.name, frames.get(file.stem)) for file in files]
    if without := [file.name for file, frame in zip(files, found, strict=True) if frame is None]:
        raise SessionError(
            f"camera '{name}': {len(without)} of {len(files)} images in {source} have no row in "
            f"{path} ({_some(without)}): without a time they cannot be used; add the rows or "
            "remove the files"
        )
    return files, list(found)


def _refuse_unstamped(
    name: str, source: str, by_number: dict[int | None, Path], path: Path, stamps: Stamps
) -> None:
    known = set(stamps.frames.tolist())
    unstamped = [number for number in by_number if number not in known]
    if not unstamped:
        return
    if len(unstamped) == len(by_number) or len(by_number) == len(known):
        raise SessionError(
            f"camera '{name}': the numbers of the files {source} ({_some(list(by_number))}) are "
            f"not the frame numbers of {path} ({_some(stamps.frames)}); renumber one of them"
        )
    raise SessionError(
        f"camera '{name}': {len(unstamped)} of {len(by_number)} images have no row in {path} "
        f"(frame {_some(unstamped)}): without a time they cannot be used; "
        "add the rows or remove the files"
    )


def _count_message(name: str, source: str, count: int, path: Path, stamps: Stamps, odd: str) -> str:
    why = f"{odd} has no frame number in its name" if odd else "names repeat frame numbers"
    return (
        f"camera '{name}': {source} has {count} images but {path} has {len(stamps.frames)} rows; "
        f"it is unknown which belong together, because {why}"
    )


def _some(numbers: Iterable[object]) -> str:
    values = [str(n) for n in numbers]
    return ", ".join(values[:4]) + (f", ... {values[-1]}" if len(values) > 4 else "")

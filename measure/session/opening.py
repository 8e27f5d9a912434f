"""Opening a session folder, and checking all that can be checked without decoding it."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from measure.arrays import Bytes
from measure.errors import CalibrationError, SessionError
from measure.model import Body, Camera
from measure.reading import FileModel, missing_message
from measure.session.body_file import BodyModel, read_body
from measure.session.calibration_file import Calibration
from measure.session.calibrations import read_calibration
from measure.session.consistency import check_bodies, check_unit
from measure.session.files import Name, SafeName, load_toml
from measure.session.session import Session
from measure.session.stated_rig import Unit
from measure.session.streams import AlteredStream, Stream, open_image_stream
from measure.session.timestamps import LATEST_S, check_time_units, read_stamps
from measure.session.video_file import open_video_stream

Mirrored = Literal["left to right", "top to bottom", "upside down"]
"""How a camera's pictures are stored; they are turned back before they are measured."""
_TURNED_BACK: dict[str, Callable[[Bytes], Bytes]] = {
    "left to right": lambda pixels: pixels[:, ::-1],
    "top to bottom": lambda pixels: pixels[::-1],
    "upside down": lambda pixels: pixels[::-1, ::-1],
}


class SessionTable(FileModel):
    """The `[session]` table; every path is relative to the file."""

    name: str = ""
    description: str = ""
    body: Name | None = None
    bodies: Annotated[list[Name], Field(default_factory=list)]
    reference: str = ""
    calibration: Name | None = None
    calibration_unit: Unit | None = None
    truth: Name | None = None


class CameraTable(FileModel):
    """One `[[cameras]]` table."""

    name: SafeName
    images: Name | None = None
    video: Name | None = None
    timestamps: Name | None = None
    time_column: Name | None = None
    time_offset_s: Annotated[FiniteFloat, Field(ge=-LATEST_S, le=LATEST_S)] = 0.0
    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    frames: tuple[int, int] | None = None  # numbers of the first and the last that are used
    mirrored: Mirrored | None = None
    red_blue_exchanged: bool = False
    controls: dict[str, int | str] = Field(default_factory=dict)  # kept for people to read

    @model_validator(mode="after")
    def _one_source(self) -> CameraTable:
        if (self.images is None) == (self.video is None):
            raise ValueError(f"camera '{self.name}' needs either images or video")
        if self.video is not None and "*" in self.video:
            raise ValueError(f"'{self.video}' are several files: name pictures by the key images")
        return self


class RobotTable(FileModel):
    """The `[robot]` table."""

    log: Name


class SessionModel(FileModel):
    """A whole `session.toml`."""

    session: SessionTable
    cameras: Annotated[list[CameraTable], Field(default_factory=list)]
    body: BodyModel | None = None
    robot: RobotTable | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> SessionModel:
        given = (self.body is not None, self.session.body is not None, bool(self.session.bodies))
        if sum(given) > 1:
            raise ValueError(
                'give the body once: body = "body.toml" or bodies = ["tool.toml", "base.toml"] in '
                "[session], or [body]"
            )
        names = [camera.name for camera in self.cameras]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two cameras are called '{name}'")
        if len(names) < 2:
            raise ValueError(
                f"a measurement needs at least two cameras, the session has {len(names)}"
            )
        return self


def clock_digest(streams: Iterable[Stream]) -> str:
    """A fingerprint of all cameras' stamps."""
    found = hashlib.sha256()
    for stream in streams:
        found.update(stream.name.encode() + stream.frames.tobytes() + stream.times_s.tobytes())
    return found.hexdigest()


def clock_values(digest: str, shifts_s: Mapping[str, float]) -> dict[str, object]:
    """The entries on clocks in a calibration's provenance; `shift_clocks` reads them."""
    return {"clock_digest": digest, "clock_shifts_s": dict(shifts_s)} if shifts_s else {}


def shift_clocks(
    streams: Mapping[str, Stream], digest: str, provenance: Mapping[str, Any], path: Path
) -> dict[str, float]:
    """Add the clock offsets of a calibration, if it is from these stamps, to the streams' times.

    Gives what was added, by camera; CalibrationError if an offset is no number.
    """
    if provenance.get("clock_digest") != digest:
        return {}
    try:
        offsets = {str(n): float(s) for n, s in dict(provenance["clock_shifts_s"]).items()}
    except (KeyError, TypeError, ValueError):
        raise CalibrationError(
            f"{path}: provenance.clock_shifts_s must name cameras and seconds; refine again, or "
            "remove clock_digest"
        ) from None
    shifts = {name: seconds for name, seconds in offsets.items() if name in streams}
    for name, seconds in shifts.items():
        streams[name].times_s = streams[name].times_s + seconds
    return shifts


def shift_notes(shifts_s: Mapping[str, float]) -> tuple[str, ...]:
    """A line for the user, if anything was added."""
    if not shifts_s:
        return ()
    offsets = ", ".join(f"{name} {1e3 * seconds:+.1f} ms" for name, seconds in shifts_s.items())
    return (f"clocks set right as the calibration found them: {offsets}",)


_FILE = "session.toml, the file that names each camera's video or folder of pictures"


CalibrationOf = Callable[[Mapping[str, Stream]], Calibration]
"""Gives the cameras of streams of pictures by name, in their order."""


def open_session(
    path: Path | str,
    calibration: Path | str | CalibrationOf | None = None,
    body: Path | str | Body | Sequence[Path] | None = None,
    *,
    reference: str | None = None,
    clocks_apart: bool = False,
) -> Session:
    """Open a recording and check all that can be checked without decoding it.

    Args:
        path: the session's folder, or its `session.toml`.
        calibration: a calibration file to use instead of the session's own, or what gives the
            cameras where none is calibrated yet.
        body: a body, its file, or several files, to use instead of the session's own.
        reference: name of the body to measure the others relative to, instead of the session's.
        clocks_apart: open cameras without a time in common as well, to find their clocks.

    Raises:
        SessionError: a file is missing or cannot be used, a clock goes backwards, the cameras do
            not overlap in time.
        CalibrationError: a camera has no calibration, or one of another image size.
    """
    file = session_file(Path(path))
    given = load_toml(file, SessionModel)
    folder = file.parent
    bodies, relative_to = _bodies_and_reference(given, file, body, reference)
    calibration_path = file
    if not callable(calibration):
        calibration_path = _calibration_path(given, file, calibration)
    with ExitStack() as opened:
        streams = _open_all(given.cameras, folder, opened)
        if callable(calibration):
            calibration_read = calibration(streams)
        else:
            calibration_read = _calibration(given, streams, calibration_path, file)
            check_unit(calibration_read, bodies[0], str(calibration_path))
        check_time_units({name: stream.period_s for name, stream in streams.items()})
        digest = clock_digest(streams.values())
        shifts = shift_clocks(streams, digest, calibration_read.provenance, calibration_path)
        if not clocks_apart:
            check_overlap(list(streams.values()))
        opened.pop_all()  # the session closes them from here on
    return Session(
        name=given.session.name or folder.resolve().name,
        path=file,
        body=bodies[0],
        other_bodies=bodies[1:],
        reference=relative_to,
        cameras=calibration_read.cameras,
        scale_sd=calibration_read.scale_sd,
        streams=streams,
        calibration_path=calibration_path,
        truth_path=_optional(folder, given.session.truth, file),
        robot_log=_optional(folder, given.robot.log if given.robot else None, file),
        description=given.session.description,
        notes=(
            *_order_notes(calibration_read, calibration_path),
            *(n for stream in streams.values() for n in stream.notes),
            *shift_notes(shifts),
        ),
        clock_digest=digest,
        clock_shifts_s=shifts,
    )


def _open_all(tables: Iterable[CameraTable], folder: Path, opened: ExitStack) -> dict[str, Stream]:
    """The cameras' streams by name, which are closed with `opened`."""
    streams = {}
    for table in tables:
        streams[table.name] = _open_stream(table, folder)
        opened.callback(streams[table.name].close)
    return streams


@contextmanager
def open_streams(path: Path) -> Iterator[dict[str, Stream]]:
    """The cameras of a session that may have neither body nor calibration, by name."""
    file = session_file(path)
    with ExitStack() as opened:
        yield _open_all(load_toml(file, SessionModel).cameras, file.parent, opened)


def session_lacks(path: Path) -> list[str]:
    """Which of "body" and "calibration" a session does not name."""
    given = load_toml(session_file(path), SessionModel)
    bodies = given.body or given.session.body or given.session.bodies
    known = {"body": bodies, "calibration": given.session.calibration}
    return [name for name, there in known.items() if not there]


def session_truth(path: Path | str) -> Path | None:
    """The file of known poses that a session names, if any; SessionError if that is missing."""
    file = session_file(Path(path))
    return _optional(file.parent, load_toml(file, SessionModel).session.truth, file)


def session_file(path: Path) -> Path:
    """The file that describes a session, given that or the folder; SessionError without one."""
    if not path.exists():
        raise SessionError(missing_message(path))
    if path.is_file() and path.suffix != ".toml":
        raise SessionError(f"{path} is not a session: that is a folder with a {_FILE}")
    if not path.is_dir():
        return path
    file = path / "session.toml"
    if not file.exists():
        raise SessionError(f"{path} is not a session: it has no {_FILE}")
    return file


def is_session(path: Path | str) -> bool:
    """Whether a folder, or a file, is a session; a folder that is a capture as well is none."""
    path = Path(path)
    if path.is_dir():
        return (path / "session.toml").exists() and not (path / "capture.toml").exists()
    with suppress(OSError, tomllib.TOMLDecodeError, UnicodeDecodeError):
        return path.suffix == ".toml" and "session" in tomllib.loads(path.read_text("utf-8"))
    return False


def _bodies_and_reference(
    given: SessionModel,
    file: Path,
    body: Path | str | Body | Sequence[Path] | None,
    reference: str | None,
) -> tuple[tuple[Body, ...], str]:
    """The bodies to measure, and the name of the one that is the others' reference, or ""."""
    bodies = _bodies(given, file, body)
    relative_to = given.session.reference if reference is None else reference
    if body is not None and reference is None and relative_to not in [b.name for b in bodies]:
        relative_to = ""
    check_bodies(bodies, relative_to, "--body" if body is not None else str(file))
    return bodies, relative_to


def _bodies(
    given: SessionModel, file: Path, override: Path | str | Body | Sequence[Path] | None
) -> tuple[Body, ...]:
    if isinstance(override, Body):
        return (override,)
    if override is not None:
        files = [override] if isinstance(override, Path | str) else override
        return tuple(map(read_body, files))
    if given.body is not None:
        return (given.body.body(file),)
    names = given.session.bodies or list(filter(None, [given.session.body]))
    if not names:
        raise SessionError(
            f'{file}: the session names no body; add body = "body.toml" to [session], or [body]'
        )
    return tuple(read_body(file.parent / name) for name in names)


def _calibration_path(given: SessionModel, file: Path, override: Path | str | None) -> Path:
    if override is not None:
        return Path(override)
    if given.session.calibration is None:
        raise CalibrationError(
            f"{file}: the session names no calibration; add calibration = "
            '"calibration.toml" to [session]'
        )
    return file.parent / given.session.calibration


def _calibration(
    given: SessionModel, streams: Mapping[str, Stream], path: Path, file: Path
) -> Calibration:
    """The calibration of the session's cameras, in their order."""
    pictures = {name: stream.size_wh for name, stream in streams.items()}
    calibration = read_calibration(path, given.session.calibration_unit, pictures)
    cameras = []
    for name, stream in streams.items():
        if name not in calibration.names:
            raise CalibrationError(
                f"camera '{name}' of {file} has no calibration in {path}; "
                f"there is one of {', '.join(calibration.names)}"
            )
        cameras.append(calibration.camera(name))
        _check_size(stream, cameras[-1], path)
    return replace(calibration, cameras=tuple(cameras))


def _order_notes(calibration: Calibration, path: Path) -> list[str]:
    order = calibration.provenance.get("taken_in_order")
    named = f"{path} numbers its cameras: taken in the session's order, {order}"
    return [named] if order and "format" in calibration.provenance else []


def _open_stream(table: CameraTable, folder: Path) -> Stream:
    stream = _open_whole(table, folder)
    altered = table.mirrored is not None or table.red_blue_exchanged
    if not altered and table.frames is None:
        return stream
    first, last = table.frames or (stream.frames[0], stream.frames[-1])
    chosen = np.flatnonzero((stream.frames >= first) & (stream.frames <= last))
    if not len(chosen):
        raise SessionError(
            f"camera '{table.name}': frames = [{first}, {last}] leaves no picture: its frames are "
            f"{stream.frames[0]} to {stream.frames[-1]}"
        )

    def put_right(pixels: Bytes) -> Bytes:
        if table.mirrored is not None:
            pixels = _TURNED_BACK[table.mirrored](pixels)
        return pixels[:, :, ::-1] if table.red_blue_exchanged else pixels

    return AlteredStream(stream, chosen, put_right if altered else None)


def _open_whole(table: CameraTable, folder: Path) -> Stream:
    stamps_path = folder / table.timestamps if table.timestamps else None
    stamps = read_stamps(stamps_path, table.name, table.time_column) if stamps_path else None
    offset_s = table.time_offset_s
    if table.video is not None:
        video = folder / table.video
        stream: Stream = open_video_stream(table.name, video, stamps, stamps_path, offset_s)
    else:
        assert table.images is not None
        stream = open_image_stream(
            table.name, folder, table.images, stamps, stamps_path, offset_s, bits=table.bit_depth
        )
    stream.notes = (*stream.notes, *(stamps.notes if stamps else ()))
    return stream


def _check_size(stream: Stream, camera: Camera, calibrated: Path) -> None:
    have, want = stream.size_wh, camera.intrinsics.size_wh
    if have != tuple(want):
        hint = " (turned pictures are measured as stored)" if have[::-1] == tuple(want) else ""
        raise CalibrationError(
            f"camera '{camera.name}': the images ({stream.source}) are {have[0]}x{have[1]} px, but "
            f"{calibrated} calibrates {want[0]}x{want[1]} px: record or calibrate at one size{hint}"
        )


def check_overlap(streams: list[Stream]) -> None:
    """Refuse (SessionError) cameras in groups without a moment in common: they have two clocks."""
    groups: list[list[Stream]] = []
    end = np.inf
    for stream in sorted(streams, key=lambda s: float(s.times_s[0])):
        if not groups or stream.times_s[0] > end:
            groups.append([])
            end = stream.times_s[-1]
        groups[-1].append(stream)
        end = max(end, stream.times_s[-1])
    if len(groups) > 1:
        apart = min(groups, key=len)
        raise SessionError(
            f"cameras without a time in common: {_spans(apart)}; and "
            f"{_spans([s for s in streams if s not in apart])}: are all stamps on one clock? "
            "`measure sync` finds what to add (time_offset_s) where the balls move"
        )


def _spans(streams: list[Stream]) -> str:
    return ", ".join(f"{s.name} ({s.times_s[0]:.3f} to {s.times_s[-1]:.3f} s)" for s in streams)


def _optional(folder: Path, name: str | None, file: Path) -> Path | None:
    if name is None:
        return None
    path = folder / name
    if not path.exists():
        raise SessionError(f"{file}: {missing_message(path)}")
    return path

"""The capture folder: what was photographed to calibrate a rig, and where things stood."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from measure import session
from measure.arrays import Bytes, Floats
from measure.bags import is_bag, split_topic
from measure.calibration.boards import Board
from measure.calibration.markers import MarkerKind
from measure.calibration.targets import MarkerField, Tolerance, read_board, read_markers, read_marks
from measure.calibration.views import MAX_VIEWS
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Intrinsics, Projection

_VIDEO_ENDINGS = {".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v"}


class CaptureTable(session.FileModel):
    """`[capture]`."""

    name: str
    description: str = ""
    board: session.Name | None = None
    markers: session.Name | None = None
    marks: session.Name | None = None
    marker_kind: MarkerKind = "dot"
    marker_tolerance_mm: Tolerance | None = None
    board_tolerance_mm: Tolerance | None = None
    board_tolerance_deg: Tolerance | None = None
    mark_sd_px: Annotated[FiniteFloat, Field(ge=1e-3, le=1e3)] | None = None
    common_views: bool = False
    floor_z_mm: FiniteFloat | None = None
    model: Projection | None = None


class CaptureCamera(session.FileModel):
    """`[[cameras]]`: what one camera contributes; files are relative to the folder."""

    name: session.SafeName
    intrinsics: session.Name | None = None
    model: Projection | None = None
    calibration: session.Name | None = None
    board_image: session.Name | None = None
    board_quat_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    board_translation_mm: session.Position | None = None
    board_origin_px: tuple[FiniteFloat, FiniteFloat] | None = None
    marker_image: session.Name | None = None

    @model_validator(mode="after")
    def _complete(self) -> CaptureCamera:
        if (self.intrinsics is None) == (self.calibration is None):
            raise ValueError("give either intrinsics (pictures or a video) or calibration (a file)")
        if self.model and self.calibration:
            raise ValueError("model is for intrinsics: a calibration file states its own")
        if (self.board_quat_wxyz is None) != (self.board_translation_mm is None):
            raise ValueError("board_quat_wxyz and board_translation_mm belong together")
        if self.board_image is not None and self.board_quat_wxyz is None:
            raise ValueError(
                "board_image needs the board's pose: board_quat_wxyz and board_translation_mm "
                "(world_from_board)"
            )
        if self.board_quat_wxyz and abs(np.linalg.norm(self.board_quat_wxyz) - 1) > 1e-3:
            raise ValueError("board_quat_wxyz must have length 1")
        return self

    @property
    def world_from_board(self) -> RigidTransform:
        """The pose of the board in `board_image`."""
        assert self.board_quat_wxyz is not None
        assert self.board_translation_mm is not None
        return RigidTransform.from_quat_wxyz(self.board_quat_wxyz, self.board_translation_mm)


class CaptureFile(session.FileModel):
    """`capture.toml`."""

    capture: CaptureTable
    cameras: Annotated[list[CaptureCamera], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture folder, opened."""

    path: Path  # of its capture.toml
    settings: CaptureTable  # the `[capture]` table
    board: Board | None  # the board, if there is one
    markers: MarkerField  # the marker field, maybe empty
    cameras: tuple[CaptureCamera, ...]  # in the order of the file
    # hand marks (2,) px, by camera and marker name.
    marks: Mapping[str, dict[str, Floats]] = field(default_factory=dict)
    # the lenses that are given, by camera name.
    lenses: Mapping[str, Intrinsics] = field(default_factory=dict)

    def views(self, camera: CaptureCamera) -> Iterator[tuple[str, Bytes]]:
        """Name and BGR pixels of pictures of the board; CalibrationError if there are none."""
        assert camera.intrinsics is not None
        pattern, folder = camera.intrinsics, self.path.parent
        is_video = Path(pattern).suffix.lower() in _VIDEO_ENDINGS
        if is_video or is_bag(split_topic(folder / pattern)[0]):
            yield from _video(camera.name, folder / pattern)
            return
        files = session.matching_files(folder, pattern, CalibrationError)
        if not files:
            raise CalibrationError(f"camera {camera.name}: no picture matches {folder / pattern}")
        for file in files:
            yield file.name, session.read_picture(file)

    def still(self, camera: CaptureCamera, name: str, lens: Intrinsics) -> Bytes:
        """A BGR picture by which a camera is located; CalibrationError if of another size."""
        path, (width, height) = self.path.parent / name, lens.size_wh
        bgr = session.read_picture(path)
        if bgr.shape[:2] != (height, width):
            raise CalibrationError(
                f"camera {camera.name}: {path} is {bgr.shape[1]}x{bgr.shape[0]} px, its lens is "
                f"known for pictures of {width}x{height} px: give a picture as the camera took it"
            )
        return bgr


def _video(camera: str, path: Path) -> Iterator[tuple[str, Bytes]]:
    stream = session.open_video_stream(camera, path)
    try:
        # Powers of two: videos of slightly different lengths have frames in common.
        step = 2 ** max(0, (len(stream) // (2 * MAX_VIEWS)).bit_length() - 1)
        for index in range(0, len(stream), step):
            yield f"{path.name} frame {stream.frames[index]}", stream.read(index).pixels
    finally:
        stream.close()


def open_capture(path: Path | str) -> Capture:
    """Open a capture folder or its capture.toml; CalibrationError with file, line and key."""
    path = Path(path)
    file = path / "capture.toml" if path.is_dir() else path
    given = session.load_toml(file, CaptureFile, CalibrationError)
    folder, settings, names = file.parent, given.capture, [c.name for c in given.cameras]
    board = None if settings.board is None else read_board(folder / settings.board)
    markers = MarkerField()
    if settings.markers is not None:
        markers = read_markers(folder / settings.markers, settings.marker_tolerance_mm)
    marks = {} if settings.marks is None else read_marks(folder / settings.marks, markers)
    for name in names:
        if names.count(name) > 1:
            raise CalibrationError(f"{file}: camera '{name}' is there {names.count(name)} times")
    for name in marks:
        if name not in names:
            raise CalibrationError(
                f"{folder / str(settings.marks)}: no camera is called '{name}'; "
                f"there is {', '.join(names)}"
            )
    lenses = {c.name: _lens(folder / c.calibration, c) for c in given.cameras if c.calibration}
    if board is None and any(c.intrinsics or c.board_image for c in given.cameras):
        raise CalibrationError(
            f'{file}: pictures of a board need board = "board.toml" in [capture]'
        )
    return Capture(file, settings, board, markers, tuple(given.cameras), marks, lenses)


def _lens(path: Path, camera: CaptureCamera) -> Intrinsics:
    """The camera's own lens in a calibration file, or the only one there."""
    lenses = session.read_intrinsics(path)
    if camera.name not in lenses and len(lenses) != 1:
        raise CalibrationError(
            f"{path}: no camera is called '{camera.name}'; there is {', '.join(lenses)}"
        )
    return lenses.get(camera.name) or next(iter(lenses.values()))

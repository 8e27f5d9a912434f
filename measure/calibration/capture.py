"""The capture folder: what was photographed to calibrate a rig, and where things stood."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from measure import session
from measure.arrays import Bytes, Floats
from measure.calibration.boards import Board
from measure.calibration.markers import MarkerKind
from measure.calibration.targets import MarkerField, Tolerance, read_board, read_markers, read_marks
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Intrinsics, Projection

_VIDEO_ENDINGS = {".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v"}
_VIDEO_FRAMES = 80
"""Least frames read of a video, every 1st, 2nd, 4th ...: powers of two, so that videos of slightly
different lengths have frames in common."""


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


class CaptureCameraTable(session.FileModel):
    """`[[cameras]]`."""

    name: session.Name
    intrinsics: session.Name | None = None
    model: Projection | None = None
    calibration: session.Name | None = None
    board_image: session.Name | None = None
    board_quat_wxyz: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    board_translation_mm: session.Position | None = None
    board_origin_px: tuple[FiniteFloat, FiniteFloat] | None = None
    marker_image: session.Name | None = None

    @model_validator(mode="after")
    def _complete(self) -> CaptureCameraTable:
        if (self.intrinsics is None) == (self.calibration is None):
            raise ValueError("give either intrinsics (pictures or a video) or calibration (a file)")
        if self.model and self.calibration:
            raise ValueError("model is for intrinsics: a calibration file states its own")
        pose = (self.board_quat_wxyz is None, self.board_translation_mm is None)
        if pose[0] != pose[1]:
            raise ValueError("board_quat_wxyz and board_translation_mm belong together")
        if self.board_image is not None and pose[0]:
            raise ValueError(
                "board_image needs the board's pose: board_quat_wxyz and board_translation_mm "
                "(world_from_board)"
            )
        if self.board_quat_wxyz and abs(np.linalg.norm(self.board_quat_wxyz) - 1) > 1e-3:
            raise ValueError("board_quat_wxyz must have length 1")
        return self


class CaptureFile(session.FileModel):
    """`capture.toml`."""

    capture: CaptureTable
    cameras: Annotated[list[CaptureCameraTable], Field(min_length=1)]


@dataclass(frozen=True, eq=False)
class CameraCapture:
    """What one camera contributes."""

    name: str
    folder: Path
    # name and reader of each board view for the lens (a video: one for all frames).
    pictures: str | None
    known: Intrinsics | None  # its lens, if that is given
    board_image: Path | None  # picture of the board of known pose
    world_from_board: RigidTransform | None  # that pose
    marker_image: Path | None
    marks: dict[str, Floats] = field(default_factory=dict)  # hand marks, by marker name (2,) px
    # where about the board's origin appears, if that is given.
    board_origin_px: tuple[float, float] | None = None
    model: Projection | None = None  # the kind of lens to be calibrated, if that is stated

    def views(self) -> Iterator[tuple[str, Bytes]]:
        """Name and BGR pixels of the board's pictures; CalibrationError if there are none."""
        assert self.pictures is not None
        if Path(self.pictures).suffix.lower() in _VIDEO_ENDINGS:
            yield from self._video(self.folder / self.pictures)
            return
        files = session.matching_files(self.folder, self.pictures, CalibrationError)
        if not files:
            raise CalibrationError(
                f"camera {self.name}: no picture matches {self.folder / self.pictures}"
            )
        for file in files:
            yield file.name, session.read_picture(file)

    def still(self, path: Path, lens: Intrinsics) -> Bytes:
        """A BGR picture by which the camera is located; CalibrationError if of another size."""
        bgr = session.read_picture(path)
        width, height = lens.size_wh
        if bgr.shape[:2] != (height, width):
            raise CalibrationError(
                f"camera {self.name}: {path} is {bgr.shape[1]}x{bgr.shape[0]} px, its lens is "
                f"known for pictures of {width}x{height} px: give a picture as the camera took it"
            )
        return bgr

    def _video(self, path: Path) -> Iterator[tuple[str, Bytes]]:
        stream = session.open_video_stream(self.name, path)
        try:
            step = 2 ** max(0, (len(stream) // _VIDEO_FRAMES).bit_length() - 1)
            for index in range(0, len(stream), step):
                yield f"{path.name} frame {stream.frames[index]}", stream.read(index).pixels
        finally:
            stream.close()


@dataclass(frozen=True, eq=False)
class Capture:
    """A capture folder, opened."""

    path: Path
    settings: CaptureTable  # the `[capture]` table
    board: Board | None  # the board, if there is one
    markers: MarkerField  # the marker field, maybe empty
    cameras: tuple[CameraCapture, ...]  # in the order of the file


def open_capture(path: Path | str) -> Capture:
    """Open a capture folder or its capture.toml; CalibrationError with file, line and key."""
    path = Path(path)
    file = path / "capture.toml" if path.is_dir() else path
    given = session.load_toml(file, CaptureFile, CalibrationError)
    folder, settings = file.parent, given.capture
    board = None if settings.board is None else read_board(folder / settings.board)
    markers = MarkerField()
    if settings.markers is not None:
        markers = read_markers(folder / settings.markers, settings.marker_tolerance_mm)
    marks = {} if settings.marks is None else read_marks(folder / settings.marks, markers)
    names = [table.name for table in given.cameras]
    for name in names:
        if names.count(name) > 1:
            raise CalibrationError(f"{file}: camera '{name}' is there {names.count(name)} times")
    for name in marks:
        if name not in names:
            raise CalibrationError(
                f"{folder / str(settings.marks)}: no camera is called '{name}'; "
                f"there is {', '.join(names)}"
            )
    cameras = tuple(
        _camera(folder, table, marks.get(table.name, {}), settings.model) for table in given.cameras
    )
    if board is None and any(c.pictures or c.board_image for c in cameras):
        raise CalibrationError(
            f'{file}: pictures of a board need board = "board.toml" in [capture]'
        )
    return Capture(file, settings, board, markers, cameras)


def _camera(
    folder: Path, table: CaptureCameraTable, marks: dict[str, Floats], model: Projection | None
) -> CameraCapture:
    known = None
    if table.calibration is not None:
        lenses = session.read_intrinsics(folder / table.calibration)
        known = lenses.get(table.name) or (
            next(iter(lenses.values())) if len(lenses) == 1 else None
        )
        if known is None:
            raise CalibrationError(
                f"{folder / table.calibration}: no camera is called '{table.name}'; "
                f"there is {', '.join(lenses)}"
            )
    pose = None
    if table.board_quat_wxyz is not None and table.board_translation_mm is not None:
        pose = RigidTransform.from_quat_wxyz(table.board_quat_wxyz, table.board_translation_mm)
    return CameraCapture(
        table.name,
        folder,
        table.intrinsics,
        known,
        None if table.board_image is None else folder / table.board_image,
        pose,
        None if table.marker_image is None else folder / table.marker_image,
        marks,
        table.board_origin_px,
        table.model or model,
    )

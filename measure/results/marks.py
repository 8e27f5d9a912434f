"""Ball centres marked by hand in images."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np

from measure.arrays import Floats
from measure.errors import MeasureError, RunError
from measure.results.columns import integers, texts
from measure.results.run import Run
from measure.session import open_session
from measure.session.number_table import read_number_table

Marks: TypeAlias = dict[tuple[str, int, str], Floats]
"""(2,) px by camera, the camera's frame number, and ball."""


def read_marks(path: Path | str, run: Run) -> Marks:
    """Read ball centres marked by hand in the images of a run.

    The columns are `camera,frame,ball,u_px,v_px`, with frame numbers per camera.

    Frames that a run lacks because it was stopped early or skipped them may be marked.

    Raises:
        RunError: with file and line where it cannot be used; also for what is not in the run.
    """
    table = read_number_table(
        Path(path), ("frame", "u_px", "v_px"), "", RunError, words=("camera", "ball")
    )
    pixels = np.stack([table.columns["u_px"], table.columns["v_px"]], axis=1)
    frames = _Frames(run)
    marks: Marks = {}
    for line, camera, frame, ball, pixel in zip(
        table.lines,
        table.words["camera"],
        table.columns["frame"].tolist(),
        table.words["ball"],
        pixels,
        strict=True,
    ):
        if wrong := _what_is_wrong(run, frames, camera, frame, ball, pixel):
            raise RunError(f"{path}:{line}: {wrong}")
        if (camera, int(frame), ball) in marks:
            raise RunError(f"{path}:{line}: frame {frame:g} of {camera} marks '{ball}' twice")
        marks[camera, int(frame), ball] = pixel
    return marks


def passed_over(run: Run, marks: Marks) -> int:
    """How many marks are of frames that the run has not."""
    measured = _measured(run)
    return sum((camera, frame) not in measured for camera, frame, _ in marks)


class _Frames:
    """Which frames may be marked: a run's own, and those of its recording that it may lack.

    It lacks those of frame sets that were skipped and, if it was stopped early, all beyond its end.
    """

    def __init__(self, run: Run) -> None:
        self._run, self._measured = run, _measured(run)
        self._skipped = len(np.unique(integers(run.detections, "index"))) < run.poses.num_rows
        self._ends = dict(sorted(self._measured))

    def know(self, camera: str, frame: float) -> bool:
        if (camera, frame) in self._measured:
            return True
        beyond = not self._run.finished and frame > self._ends.get(camera, -1)
        if not (self._skipped or beyond):
            return False
        return self._recorded is None or frame in self._recorded.get(camera, ())

    @cached_property
    def _recorded(self) -> dict[str, set[int]] | None:
        """Frame numbers by camera; None if the recording is gone or cannot be opened."""
        if self._run.session is None:
            return None
        try:
            with open_session(self._run.session) as session:
                return {s.name: set(s.frames.tolist()) for s in session.streams.values()}
        except MeasureError:
            return None


def _measured(run: Run) -> set[tuple[str, int]]:
    """Camera and number of every frame that a run has rows of."""
    numbers = integers(run.detections, "frame").tolist()
    return set(zip(texts(run.detections, "camera").tolist(), numbers, strict=True))


def _what_is_wrong(
    run: Run, frames: _Frames, camera: str, frame: float, ball: str, pixel: Floats
) -> str:
    cameras = [one.name for one in run.cameras]
    if camera not in cameras:
        return f"no camera of {run.path} is called '{camera}'; there is {', '.join(cameras)}"
    if ball not in run.body.names:
        return f"no ball of {run.path} is called '{ball}'; there is {', '.join(run.body.names)}"
    if not np.isfinite(pixel).all():
        return f"the mark is at ({pixel[0]:g}, {pixel[1]:g}) px: both must be numbers"
    if not (frame >= 0 and frame % 1 == 0 and frames.know(camera, frame)):
        return f"{run.path} has no frame {frame:g} of {camera}"
    return ""

"""Ball centres marked by hand in images."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import numpy as np

from measure.arrays import Floats
from measure.errors import RunError
from measure.results.columns import integers, texts
from measure.results.run import Run
from measure.session.timestamps import read_number_table

Marks: TypeAlias = dict[tuple[str, int, str], Floats]
"""(2,) px by camera, the camera's frame number, and ball."""


def read_marks(path: Path | str, run: Run) -> Marks:
    """Read ball centres marked by hand in the images of a run.

    The columns are `camera,frame,ball,u_px,v_px`, with frame numbers per camera.

    Raises:
        RunError: with file and line where it cannot be used; also for what is not in the run.
    """
    table = read_number_table(
        Path(path), ("frame", "u_px", "v_px"), "", RunError, words=("camera", "ball")
    )
    pixels = np.stack([table.columns["u_px"], table.columns["v_px"]], axis=1)
    frames = _frames_of(run)
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


def _frames_of(run: Run) -> set[tuple[str, int]] | None:
    """Camera and number of every frame; None if frame sets were skipped, whose are not kept."""
    table = run.detections
    if len(np.unique(integers(table, "index"))) < run.poses.num_rows:
        return None
    numbers = integers(table, "frame").tolist()
    return set(zip(texts(table, "camera").tolist(), numbers, strict=True))


def _what_is_wrong(
    run: Run,
    frames: set[tuple[str, int]] | None,
    camera: str,
    frame: float,
    ball: str,
    pixel: Floats,
) -> str:
    cameras = [one.name for one in run.cameras]
    if camera not in cameras:
        return f"no camera of {run.path} is called '{camera}'; there is {', '.join(cameras)}"
    if ball not in run.body.names:
        return f"no ball of {run.path} is called '{ball}'; there is {', '.join(run.body.names)}"
    if not np.isfinite(pixel).all():
        return f"the mark is at ({pixel[0]:g}, {pixel[1]:g}) px: both must be numbers"
    if not (frame >= 0 and frame % 1 == 0) or (
        frames is not None and (camera, frame) not in frames
    ):
        return f"{run.path} has no frame {frame:g} of {camera}"
    return ""

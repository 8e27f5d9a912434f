"""The paper's two kinds of error, each with the other switched off; and centres marked by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError, MeasureError, RunError
from measure.geometry import Rays, align_points, nearest_point
from measure.model import Body, Camera
from measure.results.run import Run
from measure.results.statistics import PixelErrors, PositionErrors, pixel_errors, position_errors
from measure.results.tables import integers, numbers, texts
from measure.session import Trajectory, open_session
from measure.tables import read_number_table

Marks: TypeAlias = dict[tuple[str, int, str], Floats]
"""(2,) px by camera, the camera's frame number, and ball."""


def read_marks(path: Path | str, run: Run) -> Marks:
    """Read ball centres marked by hand in the images of a run.

    The columns are `camera,frame,ball,u_px,v_px`, with frame numbers per camera. Frames that a run
    lacks because it was stopped early or skipped them may be marked. RunError, with file and line:
    it cannot be used, or marks what is not in the run.
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


@dataclass(frozen=True)
class SingleErrors:
    """One kind of error alone."""

    # of the centres in the images; None where the images are taken as exact.
    pixels: PixelErrors | None
    ball: PositionErrors | None  # of single ball centres, triangulated
    body: PositionErrors | None  # of the body's origin, fitted to three or more of them


def effective_detections(run: Run) -> pa.Table:
    """The rows of the detections that a run used."""
    known = np.isfinite(numbers(run.detections, "u_px", "v_px")).all(axis=1)
    return run.detections.filter((texts(run.detections, "state") == "effective") & known)


def detection_errors_by_truth(
    run: Run, truth: Trajectory, cameras: Sequence[Camera]
) -> SingleErrors:
    """Errors of detection alone: detected centres through the true cameras, taken as exact."""
    seen = effective_detections(run)
    times_s, instants_s = numbers(seen, "time_s"), run.times_s[integers(seen, "index")]
    here = truth.covers(times_s) & truth.covers(instants_s)
    seen, times_s, instants_s = seen.filter(here), times_s[here], instants_s[here]
    if not len(seen):
        return SingleErrors(None, None, None)
    errors = numbers(seen, "u_px", "v_px") - _project(seen, run, truth, times_s, cameras)
    # Each image was taken at its own time: move its error, not its picture, to the instant.
    there = _project(seen, run, truth, instants_s, cameras)
    ball, body = _against_truth(triangulate(seen, there + errors, cameras), run, truth)
    return SingleErrors(pixel_errors(errors), ball, body)


def localisation_errors_by_truth(
    run: Run, truth: Trajectory, cameras: Sequence[Camera]
) -> SingleErrors:
    """Errors of camera localisation alone: exact centres through the run's cameras."""
    seen = effective_detections(run)
    instants_s = run.times_s[integers(seen, "index")]
    here = truth.covers(instants_s)
    seen, instants_s = seen.filter(here), instants_s[here]
    if not len(seen):
        return SingleErrors(None, None, None)
    exact = _project(seen, run, truth, instants_s, cameras)
    ball, body = _against_truth(triangulate(seen, exact, run.cameras), run, truth)
    return SingleErrors(None, ball, body)


def detection_errors_by_marks(run: Run, marks: Marks) -> SingleErrors:
    """Errors of detection alone against centres marked by hand, as the paper did.

    Both are triangulated with the run's cameras; the difference is the error.
    """
    seen = effective_detections(run)
    keys = zip(*(seen[name].to_pylist() for name in ("camera", "frame", "ball")), strict=True)
    found = [marks.get(key) for key in keys]
    seen = seen.filter(np.array([mark is not None for mark in found], dtype=bool))
    if not len(seen):
        return SingleErrors(None, None, None)
    marked = np.stack([mark for mark in found if mark is not None])
    pixels = numbers(seen, "u_px", "v_px")
    detected = triangulate(seen, pixels, run.cameras)
    by_hand = triangulate(seen, marked, run.cameras)
    both = [key for key in detected if key in by_hand]
    balls = np.array([detected[key] - by_hand[key] for key in both]).reshape(-1, 3)
    bodies, bodies_by_hand = fit_bodies(detected, run.body), fit_bodies(by_hand, run.body)
    whole = [index for index in bodies if index in bodies_by_hand]
    body = np.array([bodies[i] - bodies_by_hand[i] for i in whole]).reshape(-1, 3)
    return SingleErrors(
        pixel_errors(pixels - marked), position_errors(balls), position_errors(body)
    )


def triangulate(
    seen: pa.Table, pixels: Floats, cameras: Sequence[Camera]
) -> dict[tuple[int, str], Floats]:
    """Points nearest to the rays, unweighted, of each ball at each instant, by (index, ball).

    The centres are at `pixels` (n, 2), and the rest of each detection is a row of `seen`.
    """
    origins, directions = np.zeros((len(seen), 3)), np.zeros((len(seen), 3))
    for camera in cameras:
        mine = texts(seen, "camera") == camera.name
        rays = camera.rays(pixels[mine])
        origins[mine], directions[mine] = rays.origins, rays.directions
    groups: dict[tuple[int, str], list[int]] = {}
    names = list(zip(seen["index"].to_pylist(), seen["ball"].to_pylist(), strict=True))
    for row in np.flatnonzero(np.isfinite(directions).all(axis=1)).tolist():
        groups.setdefault(names[row], []).append(row)
    out = {}
    for key, rows in groups.items():
        if len(rows) < 2:
            continue
        try:
            out[key] = nearest_point(Rays(origins[rows], directions[rows]))
        except DegenerateGeometryError:
            continue
    return out


def fit_bodies(located: Mapping[tuple[int, str], Floats], body: Body) -> dict[int, Floats]:
    """The body's origin (3,) by index, where at least three balls not on a line are located."""
    by_index: dict[int, list[str]] = {}
    for index, ball in located:
        by_index.setdefault(index, []).append(ball)
    out = {}
    for index, names in by_index.items():
        if len(names) < 3:
            continue
        points = np.array([located[index, name] for name in names])
        try:
            pose = align_points(points, body.centers[[body.index(name) for name in names]])
        except DegenerateGeometryError:
            continue
        out[index] = pose.translation
    return out


def _against_truth(
    located: Mapping[tuple[int, str], Floats], run: Run, truth: Trajectory
) -> tuple[PositionErrors | None, PositionErrors | None]:
    indices = np.array([index for index, _ in located], dtype=np.int64)
    if not len(indices):
        return None, None
    poses = truth.at(run.times_s[indices])
    places = run.body.centers[[run.body.index(name) for _, name in located]]
    ball = np.array(list(located.values())) - poses.apply(places)
    origins = fit_bodies(located, run.body)
    if not origins:
        return position_errors(ball), None
    true_origins = truth.at(run.times_s[list(origins)]).translation
    return position_errors(ball), position_errors(np.array(list(origins.values())) - true_origins)


def _project(
    seen: pa.Table, run: Run, truth: Trajectory, times_s: Floats, cameras: Sequence[Camera]
) -> Floats:
    """Where the centres (n, 2) of the balls seen truly were in the images, at the times (n,)."""
    balls = [run.body.index(name) for name in seen["ball"].to_pylist()]
    centers = truth.at(times_s).apply(run.body.centers[balls])
    out = np.full((len(centers), 2), np.nan)
    for camera in cameras:
        mine = texts(seen, "camera") == camera.name
        out[mine] = camera.project(centers[mine])
    return out

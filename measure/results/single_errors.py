"""The paper's two kinds of error, each with the other one switched off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, align_points, nearest_point
from measure.model import Body, Camera
from measure.results.columns import Texts, integers, numbers, texts
from measure.results.marks import Marks
from measure.results.run import Run
from measure.results.statistics import PixelErrors, PositionErrors, pixel_errors, position_errors
from measure.session import Trajectory


@dataclass(frozen=True, eq=False)
class BallObservations:
    """Ball centres in images that belong to an instant, one a row.

    Attributes:
        index: (n,) of the frame set.
        ball: (n,) name.
        camera: (n,) name.
        pixels: (n, 2).
    """

    index: Ints
    ball: Texts
    camera: Texts
    pixels: Floats

    def with_pixels(self, pixels: Floats) -> BallObservations:
        """The same balls seen elsewhere."""
        return BallObservations(self.index, self.ball, self.camera, pixels)


@dataclass(frozen=True)
class SingleErrors:
    """One kind of error alone.

    Attributes:
        pixels: of the centres in the images; None where the images are taken as exact.
        ball: of single ball centres, triangulated.
        body: of the body's origin, fitted to three or more of them.
    """

    pixels: PixelErrors | None
    ball: PositionErrors | None
    body: PositionErrors | None


def effective_detections(run: Run) -> tuple[BallObservations, Floats]:
    """The detections a run used, and when (n,) each was seen."""
    table, used = run.detections, _effective(run)
    return (
        BallObservations(
            integers(table, "index")[used],
            texts(table, "ball")[used],
            texts(table, "camera")[used],
            numbers(table, "u_px", "v_px")[used],
        ),
        numbers(table, "time_s")[used],
    )


def _effective(run: Run) -> Bools:
    """Which rows of the detections (n,) a run used."""
    places = numbers(run.detections, "u_px", "v_px")
    return (texts(run.detections, "state") == "effective") & np.isfinite(places).all(axis=1)


def detection_errors_by_truth(
    run: Run, truth: Trajectory, cameras: Sequence[Camera]
) -> SingleErrors:
    """Errors of detection alone: detected centres through cameras taken as exact.

    Args:
        run: whose detections.
        truth: true poses.
        cameras: the true cameras.
    """
    seen, times_s = effective_detections(run)
    instants = run.times_s[seen.index]
    known = truth.covers(times_s) & truth.covers(instants)
    seen, times_s, instants = _select(seen, known), times_s[known], instants[known]
    if not len(seen.index):
        return SingleErrors(None, None, None)
    errors = seen.pixels - _project(seen, _centers(run.body, seen, truth, times_s), cameras)
    # Each image was taken at its own time: move its error, not its picture, to the instant.
    there = _project(seen, _centers(run.body, seen, truth, instants), cameras)
    located = triangulate(seen.with_pixels(there + errors), cameras)
    ball, body = _against_truth(located, run, truth)
    return SingleErrors(pixel_errors(errors), ball, body)


def localisation_errors_by_truth(
    run: Run, truth: Trajectory, cameras: Sequence[Camera]
) -> SingleErrors:
    """Errors of camera localisation alone: exact centres through the run's cameras.

    Args:
        run: whose cameras, and which balls it saw in which.
        truth: true poses.
        cameras: the true cameras.
    """
    seen, _ = effective_detections(run)
    instants = run.times_s[seen.index]
    known = truth.covers(instants)
    seen, instants = _select(seen, known), instants[known]
    if not len(seen.index):
        return SingleErrors(None, None, None)
    exact = _project(seen, _centers(run.body, seen, truth, instants), cameras)
    ball, body = _against_truth(triangulate(seen.with_pixels(exact), run.cameras), run, truth)
    return SingleErrors(None, ball, body)


def detection_errors_by_marks(run: Run, marks: Marks) -> SingleErrors:
    """Errors of detection alone against centres marked by hand, as the paper did.

    Both are triangulated with the run's cameras; the difference is the error.

    Args:
        run: whose detections.
        marks: (2,) px by camera, camera's frame number and ball.
    """
    frames = integers(run.detections, "frame")[_effective(run)]
    seen, _ = effective_detections(run)
    keys = zip(seen.camera.tolist(), frames.tolist(), seen.ball.tolist(), strict=True)
    found = [marks.get(key) for key in keys]
    marked = np.array([mark is not None for mark in found], dtype=bool)
    seen = _select(seen, marked)
    if not len(seen.index):
        return SingleErrors(None, None, None)
    pixels = np.stack([mark for mark in found if mark is not None])
    detected = triangulate(seen, run.cameras)
    by_hand = triangulate(seen.with_pixels(pixels), run.cameras)
    both = [key for key in detected if key in by_hand]
    balls = np.array([detected[key] - by_hand[key] for key in both]).reshape(-1, 3)
    bodies, bodies_by_hand = fit_bodies(detected, run.body), fit_bodies(by_hand, run.body)
    whole = [index for index in bodies if index in bodies_by_hand]
    body = np.array([bodies[i] - bodies_by_hand[i] for i in whole]).reshape(-1, 3)
    return SingleErrors(
        pixel_errors(seen.pixels - pixels), position_errors(balls), position_errors(body)
    )


def triangulate(seen: BallObservations, cameras: Sequence[Camera]) -> dict[tuple[int, str], Floats]:
    """Points nearest to the rays of each ball at each instant, by (index, ball).

    Unweighted, so that the weights of a triangulator are not part of the error.
    """
    origins, directions = np.zeros((len(seen.index), 3)), np.zeros((len(seen.index), 3))
    for camera in cameras:
        mine = seen.camera == camera.name
        rays = camera.rays(seen.pixels[mine])
        origins[mine], directions[mine] = rays.origins, rays.directions
    out = {}
    for key, rows in _groups(seen).items():
        good = rows[np.isfinite(directions[rows]).all(axis=1)]
        if len(good) < 2:
            continue
        try:
            out[key] = nearest_point(Rays(origins[good], directions[good]))
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


def _centers(body: Body, seen: BallObservations, truth: Trajectory, times_s: Floats) -> Floats:
    """True centres (n, 3) of the balls seen, at the times (n,)."""
    places = body.centers[[body.index(name) for name in seen.ball]]
    return truth.at(times_s).apply(places)


def _project(seen: BallObservations, centers: Floats, cameras: Sequence[Camera]) -> Floats:
    out = np.full((len(centers), 2), np.nan)
    for camera in cameras:
        mine = seen.camera == camera.name
        out[mine] = camera.project(centers[mine])
    return out


def _select(seen: BallObservations, rows: Bools) -> BallObservations:
    return BallObservations(seen.index[rows], seen.ball[rows], seen.camera[rows], seen.pixels[rows])


def _groups(seen: BallObservations) -> dict[tuple[int, str], Ints]:
    groups: dict[tuple[int, str], list[int]] = {}
    for row, key in enumerate(zip(seen.index.tolist(), seen.ball.tolist(), strict=True)):
        groups.setdefault(key, []).append(row)
    return {key: np.array(rows) for key, rows in groups.items()}

"""One method on one recording: how accurate, how often it failed, how long it took."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.methods import Method
from measure.arrays import Floats
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.model import FrameSet
from measure.session import Session, Trajectory

WRONG_MM = 2.0
"""A pose that is believed ("ok") and further off than this is a wrong answer."""


@dataclass(frozen=True)
class Trial:
    """The figures of one method on one recording.

    Attributes:
        center_px: RMS error per axis of the effective detections against the true centres.
        position_mm: 3-D RMS over the frame sets with a pose.
        rotation_deg: RMS over the same.
        missing: share of frame sets without a pose.
        wrong: share of frame sets that are "ok" and further off than `WRONG_MM`.
        flagged: share of frame sets with a flagged pose.
        covered: share of poses whose reported 95 % ellipsoid holds the true position.
        first_ref: CPU time of the first frame set, in reference operations.
        later_ref: median CPU time of the later ones.
    """

    center_px: float
    position_mm: float
    rotation_deg: float
    missing: float
    wrong: float
    flagged: float
    covered: float
    first_ref: float
    later_ref: float


def reference_s(picture: np.ndarray, repeats: int = 30) -> float:
    """CPU time of one cv2.cvtColor(BGR2HSV) of a picture: the median of some repeats."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
        spent.append(time.process_time() - start)
    return float(np.median(spent))


def run_trial(method: Method, session: Session, truth: Trajectory, registry: Registry) -> Trial:
    """Measure a recording, decoded beforehand, and compare it with the truth."""
    sets = [_decoded(frame_set) for frame_set in session.frame_sets()]
    method.pipeline(session, registry)  # compiled code is compiled now, not while it is timed
    for _ in method.pipeline(session, registry).measure(iter(sets[:2])):
        pass
    spent: list[float] = []
    pipeline = method.pipeline(session, registry)
    measured = list(pipeline.measure(_timed(sets, spent)))
    steps = np.diff([*spent, time.process_time()])
    reference = reference_s(next(iter(sets[0].images.values())).pixels)
    return _score(session, truth, measured, steps / reference)


def _decoded(frame_set: FrameSet) -> FrameSet:
    for image in frame_set.images.values():
        _ = image.pixels
    return frame_set


def _timed(sets: Iterable[FrameSet], spent: list[float]) -> Iterator[FrameSet]:
    for frame_set in sets:
        spent.append(time.process_time())
        yield frame_set


def _score(
    session: Session, truth: Trajectory, measured: list[Measurement], steps: Floats
) -> Trial:
    errors, inside, wrong = [], [], 0
    for one in measured:
        if one.pose is None:
            continue
        true = truth.at(np.array([one.pose.time_s]))[0]
        delta = one.pose.world_from_body.difference(true)
        errors.append(delta)
        distance = delta[:3] @ np.linalg.solve(one.pose.covariance[:3, :3], delta[:3])
        inside.append(distance < 7.8147)  # 95 % of chi-square with 3 degrees of freedom
        wrong += one.status is Status.OK and float(np.linalg.norm(delta[:3])) > WRONG_MM
    count = len(measured)
    flagged = sum(one.status is Status.FLAGGED for one in measured)
    table = np.array(errors).reshape(-1, 6)
    return Trial(
        center_px=_center_error(session, truth, measured),
        position_mm=_rms(table[:, :3]),
        rotation_deg=float(np.degrees(_rms(table[:, 3:]))),
        missing=1 - len(errors) / count,
        wrong=wrong / count,
        flagged=flagged / count,
        covered=float(np.mean(inside)) if inside else float("nan"),
        first_ref=float(steps[0]),
        later_ref=float(np.median(steps[1:])),
    )


def _rms(rows: Floats) -> float:
    """Root of the mean squared length of rows; NaN if there are none."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1)))) if len(rows) else float("nan")


def _center_error(session: Session, truth: Trajectory, measured: list[Measurement]) -> float:
    squares = []
    for one in measured:
        for view in one.views:
            if not view.effective or view.detection is None:
                continue
            place = truth.at(np.array([view.detection.time_s]))[0]
            ball = session.body.balls[session.body.index(view.ball)]
            true = session.camera(view.camera).project(place.apply(ball.center_mm)[None])[0]
            squares.append(np.mean((view.detection.center_px - true) ** 2))
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")

"""One method on one recording: how accurate, how often it failed, how long it took."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks.bound import pose_bound
from benchmarks.errors import in_region, pose_error, rms
from benchmarks.methods import Method
from measure.arrays import Floats
from measure.host import Registry
from measure.measuring import Measurement, Status
from measure.measuring.burn_in import calibrated
from measure.model import FrameSet
from measure.session import Session, Trajectory

WRONG_MM = 2.0
"""Position error from which an unflagged pose ("ok") counts as wrong."""
_REFERENCES = 3
"""Reference operations before every frame set; other load on the machine slows both."""


@dataclass(frozen=True)
class Trial:
    """The figures of one method on one recording.

    Attributes:
        center_px: RMS error per axis of the effective detections against the true centres.
        position_mm: 3-D RMS over the frame sets with a pose.
        rotation_deg: RMS over the same.
        over_bound: the first over its Cramér-Rao bound.
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
    over_bound: float
    missing: float
    wrong: float
    flagged: float
    covered: float
    first_ref: float
    later_ref: float


@dataclass(frozen=True)
class CenterError:
    """Error of the centre of one effective detection.

    Attributes:
        error_px: (2,) detected minus true centre.
        from_axis: (2,) the true centre seen from the picture of the optical axis, as tangents.
    """

    error_px: Floats
    from_axis: Floats

    @property
    def outward_px(self) -> float:
        """The error's part that points away from the optical axis."""
        return float(self.error_px @ self.from_axis / np.linalg.norm(self.from_axis))

    @property
    def off_axis_deg(self) -> float:
        """Angle between the line of sight and the optical axis."""
        return float(np.degrees(np.arctan(np.linalg.norm(self.from_axis))))


def reference_s(picture: np.ndarray, repeats: int = 30) -> float:
    """CPU time of one cv2.cvtColor(BGR2HSV) of a picture: the median of some repeats."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
        spent.append(time.process_time() - start)
    return float(np.median(spent))


def run_trial(
    method: Method, session: Session, truth: Trajectory, registry: Registry, bounds: Floats
) -> Trial:
    """Measure a recording, decoded beforehand, and compare it with the truth.

    Args:
        method: the method.
        session: the recording.
        truth: where the body was.
        registry: where parts are looked up.
        bounds: (n, 6, 6) see `bounds_of`.
    """
    measured, steps = measure_timed(method, session, registry)
    return _score(session, truth, measured, steps, bounds)


def measure_timed(
    method: Method, session: Session, registry: Registry
) -> tuple[list[Measurement], Floats]:
    """The measurements, and CPU time (n,) of every frame set, in reference operations.

    The burn-in is not timed.
    """
    sets = [_decoded(frame_set) for frame_set in session.frame_sets()]
    method.pipeline(session, registry)  # compiled code is compiled now, not while it is timed
    for _ in method.pipeline(session, registry).measure(iter(sets[:2])):
        pass
    steps: list[float] = []
    pipeline = calibrated(
        method.pipeline(session, registry),
        lambda body, cameras: method.pipeline(
            replace(session, body=body, cameras=tuple(cameras)), registry
        ),
        lambda: sets,
    )
    measured = list(pipeline.measure(_timed(sets, steps)))
    return measured, np.array(steps)


def bounds_of(session: Session, truth: Trajectory) -> Floats:
    """Cramér-Rao bounds (n, 6, 6) of all frame sets' poses."""
    sets = session.frame_sets()
    return np.array([pose_bound(session.body, session.cameras, s, truth, s.time_s) for s in sets])


def center_errors(
    session: Session, truth: Trajectory, measured: list[Measurement]
) -> Iterator[CenterError]:
    """Errors of all effective detections, each at its own picture's time."""
    for one in measured:
        for view in one.views:
            if not view.effective or view.detection is None:
                continue
            camera = session.camera(view.camera)
            place = truth.at(np.array([view.detection.time_s]))[0]
            ball = session.body.balls[session.body.index(view.ball)]
            center = place.apply(ball.center_mm)[None]
            seen = camera.camera_from_world.apply(center)[0]
            error = view.detection.center_px - camera.project(center)[0]
            yield CenterError(error, seen[:2] / seen[2])


def _decoded(frame_set: FrameSet) -> FrameSet:
    for image in frame_set.images.values():
        _ = image.pixels
    return frame_set


def _timed(sets: Iterable[FrameSet], steps: list[float]) -> Iterator[FrameSet]:
    for frame_set in sets:
        reference = reference_s(next(iter(frame_set.images.values())).pixels, _REFERENCES)
        start = time.process_time()
        yield frame_set
        steps.append((time.process_time() - start) / reference)


def _score(
    session: Session, truth: Trajectory, measured: list[Measurement], steps: Floats, bounds: Floats
) -> Trial:
    errors, inside, wrong = [], [], 0
    for one in measured:
        if one.pose is None:
            continue
        delta = pose_error(one, truth)
        errors.append(delta)
        inside.append(in_region(delta, one.pose, 3))
        wrong += one.status is Status.OK and float(np.linalg.norm(delta[:3])) > WRONG_MM
    count = len(measured)
    flagged = sum(one.status is Status.FLAGGED for one in measured)
    table = np.array(errors).reshape(-1, 6)
    off = [center.error_px for center in center_errors(session, truth, measured)]
    bound = float(np.sqrt(np.mean(np.trace(bounds[:, :3, :3], axis1=1, axis2=2))))
    return Trial(
        center_px=rms(np.array(off).reshape(-1, 2)) / np.sqrt(2),
        position_mm=rms(table[:, :3]),
        rotation_deg=float(np.degrees(rms(table[:, 3:]))),
        over_bound=rms(table[:, :3]) / bound,
        missing=1 - len(errors) / count,
        wrong=wrong / count,
        flagged=flagged / count,
        covered=float(np.mean(inside)) if inside else float("nan"),
        first_ref=float(steps[0]),
        later_ref=float(np.median(steps[1:])),
    )

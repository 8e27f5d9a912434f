"""The balls' radii, and a common factor of their distances, against those of the body file.

A ball's outline is as large as its radius and distance say; the distance is known from the rays.
What detectors learn of the balls' appearance rests on the radii that they are given, so that an
error is partly learnt as appearance, and the outlines show only a share of it: the estimate goes on
from there (secant method) to where outlines and radii agree.

The balls' positions come from rays alone. If all lie too far apart by one factor, the scale of the
calibration or the lengths of the body file are off; the pose, in which the body is rigid, hides it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.limits import SIGNIFICANT_SIGMAS
from measure.measuring.measurement import Measurement
from measure.model import BallPosition, Body, Camera, Detection, Doubt, Pose
from measure.model.body import COMMON_RADIUS_VARIANCE
from measure.model.observations import stacked_positions

_LEAST_VIEWS = 8  # Ball-views that tell a ball's size
_SHARE_SHOWN = 0.5
"""Share of an error that the outlines show at first: 0.25 to 0.6 on path-traced recordings."""
_LEAST_SHARE_SHOWN = 0.25
_COMMON_VARIANCE = 0.8
"""Share of the variance of measured radii that all balls have in common: blur, noise and light make
all outlines larger or smaller. Measured on path-traced recordings."""
_DOUBT, _CONTRADICTION = 3.0, 6.25
"""Squared Mahalanobis distances from which outlines are measured a second time, and contradict the
body file: 4 and 1 in 10 (chi-square, three degrees of freedom)."""
_LEAST_TOLERANCE_MM = 1e-4
_UNKNOWN_MM2 = 1e6
_ITERATIONS = 20


class OutlineGrowth(NamedTuple):
    """How much larger than expected k balls' outlines are."""

    # (k,) of the radii, medians over ball-views; 0 for a ball that is hardly seen.
    growth_mm: Floats
    covariance_mm2: Floats  # (k, k) that of a single view of each: views share their errors

    def misfit(self, body: Body) -> float:
        """Squared Mahalanobis distance from a body with its uncertain radii, for three balls."""
        known = body.radius_covariance + self.covariance_mm2
        square = float(self.growth_mm @ np.linalg.solve(known, self.growth_mm))
        return square * 3 / len(self.growth_mm)

    def contradicts(self, body: Body) -> bool:
        """Whether the body does not look like this, but in 1 of 10 cases."""
        return self.misfit(body) > _CONTRADICTION


def seen_balls(measurements: Iterable[Measurement]) -> Iterator[tuple[RigidTransform, Detection]]:
    """Each effective detection with the pose of its frame set."""
    for measured in measurements:
        for view in measured.views if measured.pose is not None else ():
            if measured.pose is not None and view.detection is not None and view.effective:
                yield measured.pose.world_from_body, view.detection


def outline_growth(
    seen: Iterable[tuple[RigidTransform, Detection]], body: Body, cameras: Sequence[Camera]
) -> OutlineGrowth:
    """Compare outlines with those of the body's balls at these poses, world_from_body."""
    by_name = {camera.name: camera for camera in cameras}
    rows: list[list[tuple[float, float]]] = [[] for _ in body.balls]
    for world_from_body, detection in seen:
        k = body.index(detection.ball)
        ball = body.balls[k]
        center, camera = world_from_body.apply(ball.center_mm), by_name[detection.camera]
        if np.linalg.norm(center - camera.center) <= ball.radius_mm:
            continue  # a pose that cannot be: it tells no size
        outline = camera.outline(center, ball.radius_mm)
        expected_px = np.mean(np.linalg.norm(outline - outline.mean(axis=0), axis=1))
        if np.isfinite(expected_px):
            mm_per_px = ball.radius_mm / float(expected_px)
            growth_mm = mm_per_px * detection.radius_px - ball.radius_mm
            rows[k].append((growth_mm, mm_per_px**2 * detection.variance_px2))
    growth, variance = np.zeros(len(rows)), np.full(len(rows), _UNKNOWN_MM2)
    for k, row in enumerate(rows):
        if len(row) >= _LEAST_VIEWS:
            growth[k], variance[k] = np.median(row, axis=0)
    share = (1 - _COMMON_VARIANCE) * np.eye(len(rows)) + _COMMON_VARIANCE
    return OutlineGrowth(growth, share * np.sqrt(np.outer(variance, variance)))


class FittedRadii(NamedTuple):
    """A body whose radii are those that its outlines are fitted with."""

    body: Body
    contradict: bool  # whether the outlines contradict the radii of the file


def with_estimated_radii(body: Body, measure: Callable[[Body], OutlineGrowth]) -> FittedRadii:
    """The body with what file and outlines together say of its radii.

    Where the outlines contradict the file, the radii are estimated from both. Else the balls are
    as large as the file says, and only what makes one ball's outlines larger than the others' in
    all cameras, as a colour can, is taken into the radii that outlines are fitted with. Growth that
    all balls have in common needs no such care: the edge offset of each camera takes it up.
    Growth of single balls is shrunk by the share that noise has in it (James and Stein 1961).

    Args:
        measure: how much larger the outlines of a body are than expected; called a second time
            where they may contradict the file.
    """
    first = measure(body)
    shown = first._replace(growth_mm=first.growth_mm / _SHARE_SHOWN)
    if shown.misfit(body) > _DOUBT:
        way = shown.growth_mm
        second = measure(body.with_radii(body.radii + way, body.radius_covariance))
        share = (first.growth_mm - second.growth_mm) / np.where(way == 0, np.inf, way)
        way = way + second.growth_mm / np.clip(share, _LEAST_SHARE_SHOWN, 1.0)
        shown = first._replace(growth_mm=way)
    gone, covariance = _posterior(body, shown)
    if shown.contradicts(body):
        return FittedRadii(body.with_radii(body.radii + gone, covariance), True)
    own = first.growth_mm - first.growth_mm.mean()
    noise = (1 - _COMMON_VARIANCE) * np.mean(np.diag(first.covariance_mm2))
    spread = max(own @ own / (len(own) - 1), noise)
    own *= 1 - noise / spread
    # What the radii may be off by, by the outlines, counts as their uncertainty.
    left = gone - own
    return FittedRadii(body.with_radii(body.radii + own, covariance + np.outer(left, left)), False)


def _posterior(body: Body, shown: OutlineGrowth) -> tuple[Floats, Floats]:
    """Correction (k,) in mm and covariance (k, k) of the radii by both file and outlines.

    Where they contradict each other, the variances of the file's error, the part that balls have in
    common and their own, are estimated as well: as factors of the stated ones that make what is
    shown most likely (MacKay 1992, fixed point of the evidence).
    """
    k = len(body.balls)
    parts = np.hstack([np.ones((k, 1)), np.eye(k)])
    stated = np.array([COMMON_RADIUS_VARIANCE, *[1 - COMMON_RADIUS_VARIANCE] * k])
    stated *= max(body.radius_tolerance_mm, _LEAST_TOLERANCE_MM) ** 2
    variances, contradict = stated, shown.contradicts(body)
    for _ in range(_ITERATIONS if contradict else 1):
        prior = parts * variances
        gain = prior.T @ np.linalg.inv(prior @ parts.T + shown.covariance_mm2)
        found, determined = gain @ shown.growth_mm, np.diag(gain @ parts)
        if contradict:
            own = np.sum(found[1:] ** 2) / np.sum(determined[1:])
            estimated = np.array([found[0] ** 2 / determined[0], *[own] * k])
            variances = np.maximum(stated, estimated)
    known = prior @ parts.T
    return parts @ found, known - parts @ gain @ known


_MEMORY_FRAME_SETS = 300


class ScaleMonitor:
    """Follows the factor from one frame set to the next, and flags poses where it is not 1.

    The errors of neighbouring frame sets are alike, so the factor's standard deviation is that of
    one frame set: it does not fall with their number.
    """

    def __init__(self, body: Body) -> None:
        self._body = body
        self._weight = self._weighted = self._count = 0.0

    def judged(self, measured: Measurement) -> Measurement:
        """The measurement, flagged if the factor is not 1; frame sets come in order.

        Poses with flags do not count towards the factor: their balls may be others.
        """
        pose = measured.pose
        if pose is None:
            return measured
        if not pose.flags:
            self._take(pose, measured.positions)
        if not self._weight:
            return measured
        off, sd = self._weighted / self._weight, math.sqrt(self._count / self._weight)
        if abs(off) <= SIGNIFICANT_SIGMAS * sd:
            return measured
        return measured.flagged(Doubt("scale", times=1 + off, sd=sd))

    def _take(self, pose: Pose, positions: Sequence[BallPosition]) -> None:
        """Add one frame set to the mean, and let the older ones count a little less."""
        found = _relative_scale(pose, positions, self._body)
        if found is None:
            return
        off, variance = found
        keep = 1 - 1 / _MEMORY_FRAME_SETS
        self._count = keep * self._count + 1
        self._weight = keep * self._weight + 1 / variance
        self._weighted = keep * self._weighted + off / variance


def _relative_scale(
    pose: Pose, positions: Sequence[BallPosition], body: Body
) -> tuple[float, float] | None:
    """The scale, less 1, of the similarity from body to positions, and its variance.

    Least squares with the pose's rotation (Umeyama 1991, equation 42), and first-order propagation.
    """
    if len(positions) < 2:
        return None
    centers, covariances = stacked_positions(tuple(positions))
    arms = body.centers_of([position.ball for position in positions])
    arms = pose.world_from_body.rotate(arms - arms.mean(axis=0))
    total = float(np.sum(arms**2))
    if total == 0:  # positions of one ball only
        return None
    by_center = arms / total
    variance = np.einsum("ni,nij,nj->", by_center, covariances + body.center_covariance, by_center)
    return float(np.sum(by_center * centers)) - 1, float(variance)

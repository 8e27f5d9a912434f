"""When the appearance of balls in a camera is estimated, and from which pictures."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from measure.arrays import Bytes, Floats
from measure_plugins._outline.appearance.interreflection import (
    ball_reflection_shares,
    balls_behind,
    balls_nearer,
)
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.fitting.edges import INSIDE_PX, OUTSIDE_PX
from measure_plugins._outline.sampling.rays import STEPS, cast_rays, frame_about, mark_occluded
from measure_plugins._outline.self_calibration.estimate import (
    AppearanceEstimate,
    estimate_appearance,
)
from measure_plugins._outline.self_calibration.patch import BallPatch
from measure_plugins._outline.self_calibration.point_lights import (
    light_equations,
    solve_point_lights,
)
from measure_plugins._outline.self_calibration.response_and_blur import misfits
from measure_plugins._outline.self_calibration.trust import (
    correction_weight_of,
    prediction_agreement,
)

_FIRST_ESTIMATE = 2  # Number of the picture of the first estimate; the one before is only kept
_INTERVAL_FACTOR = 4
"""Each estimate waits for this many times as many pictures as the one before: light and exposure
may change, but estimates must take little of the whole time."""
_GAP_PICTURES = 8
"""Pictures without balls that count as well if they are more, once there have been estimates: light
changes with time, and a run that is resumed sees few of those before."""
_KEPT_IMAGES = 4
_ENOUGH_ESTIMATES = 2  # Later estimates are hardly better than the one of this number
_BORDER_PX = 2.0

Cone = tuple[Floats, float, float]
"""Unit axis (3,), half angle in rad, distance in mm."""


class SelfCalibration:
    """Estimates the appearance of balls in one camera now and then, from its last pictures."""

    def __init__(
        self, lens: Floats, world_from_camera: Floats, rays: int, margin_px: float
    ) -> None:
        """For a camera with this lens row (16,) and rotation (3, 3)."""
        self._lens, self._world_from_camera = lens, world_from_camera
        self._rays, self._margin_px = rays, margin_px
        self._count, self._kept, self._due = 0, 1, _FIRST_ESTIMATE
        self._first_s = self._period_s = np.inf
        self._patches: deque[list[BallPatch]] = deque(maxlen=_KEPT_IMAGES)
        self._estimates, self._latest_s = 0, -np.inf
        self._estimate: AppearanceEstimate | None = None
        self._assume_bent = False
        self._others: list[AppearanceEstimate] = []

    @property
    def settled(self) -> bool:
        """Whether there have been enough estimates to start measuring."""
        return self._estimates >= _ENOUGH_ESTIMATES

    @property
    def estimate(self) -> AppearanceEstimate | None:
        """The last estimate; None before there have been enough, or if patches were too few."""
        return self._estimate if self.settled else None

    def fuse(
        self, now: Appearance, estimates: Sequence[AppearanceEstimate], bent: bool
    ) -> Appearance:
        """The appearance by the estimates of all cameras.

        Args:
            estimates: the last of every camera, this one's own among them.
            bent: whether the cameras have shown together that their tone curve is bent.
        """
        if self._estimate is None:
            return now
        self._others = [one for one in estimates if one is not self._estimate]
        self._assume_bent |= bent
        if bent and not self._estimate.bent:
            return self._estimation(now)()
        return self._fused(self._estimate)

    def wants_image(self, found: int, time_s: float) -> bool:
        """Whether to keep, or estimate from, a picture, no earlier than others; call it for all."""
        if found == 0 or time_s <= self._latest_s:
            return False
        missed = (time_s - self._latest_s) / self._period_s
        self._count += round(missed) if missed > _GAP_PICTURES else 1
        self._first_s, self._latest_s = min(self._first_s, time_s), time_s
        if not self.settled:
            self._period_s = (time_s - self._first_s) / max(self._count - 1, 1) or np.inf
        return self._count >= self._kept

    def add_image(
        self, pixels: Bytes, seen: Sequence[Cone], others: Sequence[Cone], now: Appearance
    ) -> Callable[[], Appearance] | None:
        """Keep a wanted picture; return an estimation if one is due.

        The estimation takes as long as dozens of pictures, and may run later: it uses the pictures
        that are kept now.

        Args:
            pixels: (h, w, 3) the picture.
            seen: outlines found in it; their half angles from known distances.
            others: outlines of balls that are there but were not found.
        """
        while self._kept <= self._count:  # after a gap the next of the usual numbers
            self._kept *= 2
        self._patches.append([self._patch(pixels, cone, (*seen, *others)) for cone in seen])
        if self._count < self._due:
            return None
        self._due, self._estimates = _INTERVAL_FACTOR * self._count, self._estimates + 1
        return self._estimation(now)

    def _estimation(self, now: Appearance) -> Callable[[], Appearance]:
        patches = [patch for picture in self._patches for patch in picture]

        def run() -> Appearance:
            self._estimate = estimate_appearance(
                patches, now, self._world_from_camera, self._assume_bent
            )
            return now if self._estimate is None else self._fused(self._estimate)

        return run

    def _fused(self, estimate: AppearanceEstimate) -> Appearance:
        """An estimate, with point lights and correction weight by the other cameras too."""
        own, now = estimate.light_by(estimate.bent), estimate.appearance
        lights = [one.light_by(self._assume_bent or one.bent) for one in self._others]
        of_others = [light for light in lights if light is not None]
        if own is not None and of_others and len(now.point_lights) > 0:
            now = replace(now, point_lights=solve_point_lights([own, *of_others]))
        weight = correction_weight_of(one.agreement for one in (estimate, *self._others))
        return now if weight == now.correction_weight else replace(now, correction_weight=weight)

    def warm_up(self, pixels: Bytes, cone: Cone, now: Appearance) -> None:
        """Compile what an estimation runs."""
        patches = [self._patch(pixels, cone, [])]
        misfits(patches, now)
        prediction_agreement(patches, now)
        solve_point_lights([light_equations(patches, now, self._world_from_camera)])

    def _patch(self, pixels: Bytes, cone: Cone, all_cones: Sequence[Cone]) -> BallPatch:
        axis, half_angle, distance = cone
        rows = np.array([[*a, h, d] for a, h, d in (cone, *all_cones)])
        nearer, frame = balls_nearer(rows[0], rows), frame_about(axis)
        rays, scale = cast_rays(frame, half_angle, self._rays, self._lens)
        reach = (INSIDE_PX[0], OUTSIDE_PX[1])
        mark_occluded(rays, scale, frame, half_angle, nearer, reach, self._margin_px)
        part, corner = _cut(pixels, rays.points)
        behind = ball_reflection_shares(balls_behind(rows[0], rows), frame, half_angle, rays.around)
        rays, scale_px = rays._replace(points=rays.points - corner), float(np.mean(scale))
        return BallPatch(part, rays, half_angle, scale_px, frame, behind, distance)


def _cut(pixels: Bytes, points: Floats) -> tuple[Bytes, Floats]:
    """The part of a picture that rays across an outline (n, 2) touch, and its corner (2,) in px."""
    reach = STEPS[-1] + _BORDER_PX
    size = np.array(pixels.shape[1::-1])
    low = np.clip(np.floor(points.min(axis=0) - reach), 0, size - 1).astype(int)
    high = np.clip(np.ceil(points.max(axis=0) + reach), 1, size).astype(int)
    part = np.ascontiguousarray(pixels[low[1] : high[1] + 1, low[0] : high[0] + 1])
    return part, low.astype(np.float64)


class BackgroundEstimation:
    """Runs a camera's estimations in a thread; all cameras share it, or no core would measure."""

    _pool = ThreadPoolExecutor(1, thread_name_prefix="estimation")

    def __init__(self) -> None:
        self._running: Future[Appearance] | None = None

    def start(self, estimation: Callable[[], Appearance]) -> None:
        """Start an estimation, unless another is running."""
        if self._running is None:
            self._running = self._pool.submit(estimation)

    def result(self) -> Appearance | None:
        """The result of a finished estimation, once; else None."""
        if self._running is None or not self._running.done():
            return None
        finished, self._running = self._running, None
        return finished.result()

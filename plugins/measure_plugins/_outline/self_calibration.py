"""When the appearance of balls in a camera is estimated, from which pictures, and its trust.

An estimate holds tone curve, blur and lights of the camera, and the surface of the balls (formula
22 of docs/explanation/outline.md).

The correction weight is the share of the predicted bias of edges that is subtracted (formula 20).
The two edges of a ray, without grey and with it, lie apart by an amount that does not depend on
where the ball is. The slope of what is seen of it over what is predicted tells how good predictions
are: nearly one before plain grey, less than half in pictures of webcams.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Bytes, Floats
from measure.estimation.losses import tukey_weights
from measure.geometry.covariance import MAD_TO_SD
from measure.limits import TINY
from measure_plugins._outline.appearance import (
    DEFAULT_CORRECTION_WEIGHT,
    Appearance,
    ball_reflection_shares,
    balls_behind,
    balls_nearer,
)
from measure_plugins._outline.edges import INSIDE_PX, OUTSIDE_PX, find_edge_pairs
from measure_plugins._outline.point_lights import (
    LightEquations,
    light_equations,
    solve_point_lights,
    with_point_lights,
)
from measure_plugins._outline.rays import (
    CLEAR,
    STEPS,
    TOGETHER,
    cast_rays,
    frame_about,
    mark_occluded,
)
from measure_plugins._outline.response import (
    BENDS_SD,
    BallPatch,
    as_stated,
    bent_appearance,
    choose_grazing_reflection,
    clear_patches,
    grouped_inputs,
    misfits,
    refined_bends,
    residual_ratio,
    straight_appearance,
    surface_bounds,
    unclipped_patches,
    useful_patches,
)

_WEIGHT_UNSEEN, _WEIGHT_RANGE = 0.65, 0.4
"""The weight at a slope of 0, and how much more at a slope of 1: chosen on simulated scenes in
other light, with known truth."""
_PRIOR = 100.0 * np.array([(DEFAULT_CORRECTION_WEIGHT - _WEIGHT_UNSEEN) / _WEIGHT_RANGE, 1.0])
_MIN_RAYS = 100
_MIN_CONTRAST = 0.06
_ITERATIONS = 10


def correction_weight_of(agreements: Iterable[Floats]) -> float:
    """The correction weight by the agreement of all cameras of a recording."""
    both, square = sum(agreements, start=_PRIOR)
    return float(_WEIGHT_UNSEEN + _WEIGHT_RANGE * np.clip(both / square, 0.0, 1.0))


def prediction_agreement(patches: Sequence[BallPatch], appearance: Appearance) -> Floats:
    """Agreement of seen and predicted separations of edge pairs, robustly (Tukey's biweight).

    Returns:
        (2,) sums in px^2 over rays: of seen times predicted separations, and of predicted squared.
    """
    pairs = [_edge_separations(patch, appearance) for patch in patches]
    seen, predicted = np.concatenate([np.empty((2, 0)), *pairs], axis=1)
    if seen.size < _MIN_RAYS:
        return np.zeros(2)
    weights, products = np.ones(len(seen)), np.stack([seen * predicted, predicted**2])
    for _ in range(_ITERATIONS):
        both, square = sums = products @ weights
        left = seen - both / (square + TINY) * predicted
        weights = tukey_weights((left / (MAD_TO_SD * np.median(np.abs(left)) + TINY)) ** 2)
    return np.asarray(sums)


def _edge_separations(patch: BallPatch, appearance: Appearance) -> Floats:
    """Separations (2, k) on clear rays, seen and predicted, less their medians."""
    inputs = grouped_inputs(patch, appearance)
    found = find_edge_pairs(inputs)
    apart = np.stack([found.at, np.repeat(found.predicted, TOGETHER, axis=1)])
    apart = apart[:, 0] - apart[:, 1]
    clear = (inputs.rays.status == CLEAR) & np.isfinite(apart).all(axis=0)
    clear &= found.contrast.min(axis=0) > _MIN_CONTRAST
    apart = apart[:, clear]
    return apart - np.median(apart, axis=1, keepdims=True) if clear.any() else apart


_TRY_BENT_BELOW = 0.9
_BENT_BELOW = 0.72
"""Residual ratio (see `AppearanceEstimate`) below which a bent curve is accepted, with point
lights: free bends also take up other errors of the model. On simulated scenes and rendered
recordings it is at least 0.76 where the curve is the standard's, except for two cameras of a
hundred and fifty (0.62 under a single desk lamp, 0.68 far away); where it is bent, it is at most
0.80 in front of dark cloth, and up to 0.92 in colourful rooms, for which see `has_common_response`.
The first is the ratio without point lights above which bent curves are not tried further: no
accepted one exceeded it."""


@dataclass(frozen=True, eq=False)
class AppearanceEstimate:
    """One estimate from the patches of a camera."""

    appearance: Appearance
    bent: bool  # whether its tone curve is a bent one
    residual_ratio: float  # mean square residual with a bent curve, per that with a straight one
    bends: Floats  # (3,) of the bent curve, accepted or not, see `bent_table`
    light: LightEquations  # equations of the point lights, by the straight curve
    light_if_bent: LightEquations | None  # the same by the bent one; None where that was not tried
    agreement: Floats  # (2,) of seen and predicted edges, see `prediction_agreement`

    def light_by(self, bent: bool) -> LightEquations | None:
        """Equations of the point lights by the bent curve, or by the straight one."""
        return self.light_if_bent if bent else self.light


def estimate_appearance(
    patches: Sequence[BallPatch],
    now: Appearance,
    world_from_camera: Floats,
    assume_bent: bool = False,
) -> AppearanceEstimate | None:
    """The appearance that fits the patches best; None if there are too few.

    A more complex model is chosen only where it fits clearly better. Whether the tone curve is bent
    is decided with the shading of point lights: a freely fitted polynomial takes up part of a bend.

    Args:
        world_from_camera: (3, 3) rotation of the camera.
        assume_bent: whether the cameras together have shown that their common curve is bent.
    """
    useful = useful_patches(patches)
    if not useful:
        return None
    start, clear = as_stated(now), unclipped_patches(useful)
    if_straight, if_bent = surface_bounds(useful, start.table)
    without_lights = straight_appearance(clear, start, if_straight)
    light, light_if_bent = light_equations(clear, without_lights, world_from_camera), None
    straight = with_point_lights(clear, without_lights, light)
    bent = bent_appearance(clear, without_lights, if_bent)
    ratio = residual_ratio(bent, without_lights, clear)
    if assume_bent or ratio < _TRY_BENT_BELOW:
        light_if_bent = light_equations(clear, bent, world_from_camera)
        bent = refined_bends(clear, with_point_lights(clear, bent, light_if_bent))
        light_if_bent = light_equations(clear, bent, world_from_camera)
        bent = with_point_lights(clear, bent, light_if_bent)
        ratio = residual_ratio(bent, straight, clear)
    is_bent = ratio < (1.0 if assume_bent else _BENT_BELOW)
    chosen = choose_grazing_reflection(useful, bent if is_bent else straight)
    agreement = prediction_agreement(useful, chosen)
    chosen = replace(chosen, correction_weight=correction_weight_of([agreement]))
    return AppearanceEstimate(chosen, is_bent, ratio, bent.bends, light, light_if_bent, agreement)


_MIN_BEND_EVIDENCE = 0.11
"""Least evidence of a common bend: minus the mean logarithm of the cameras' residual ratios, times
the S of their median curve in units of its prior sd. On fifty recordings (rendered, path-traced and
altered) it is at most 0.08 with the standard's curve; with bent ones at least 0.16, except 0.07 for
a mild bend in a cluttered room, which stays unnoticed."""


def has_common_response(estimates: Sequence[AppearanceEstimate]) -> bool:
    """Whether the cameras have a common response curve other than the standard's (formula 22).

    That is tested where every camera's curve is nearer to their median than that is to the
    standard's.
    """
    if len(estimates) < 2:
        return False
    bends = np.array([estimate.bends for estimate in estimates]) / BENDS_SD
    middle = np.median(bends, axis=0)
    if np.any(np.linalg.norm(bends - middle, axis=1) >= np.linalg.norm(middle)):
        return False
    evidence = -np.mean(np.log([estimate.residual_ratio for estimate in estimates]))
    return bool(evidence * abs(middle[2]) > _MIN_BEND_EVIDENCE)


_FIRST_ESTIMATE = 2  # Number of the picture of the first estimate; the one before is only kept
_INTERVAL_FACTOR = 4
"""After each time that an estimate is due, the next is after this many times as many pictures."""
_GROWN = 1.2
"""Misfit of the last picture, per that of the last estimate, above which another is made: light and
exposure may change. Under the same light it is 0.85 to 1.16, and estimating again gains nothing."""
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
        self._assume_bent, self._misfit = False, 0.0  # at the last estimate
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
        self._due = _INTERVAL_FACTOR * self._count
        if self.settled and not _typical_misfit(self._patches[-1], now) > _GROWN * self._misfit:
            return None
        self._estimates += 1
        return self._estimation(now)

    def _estimation(self, now: Appearance) -> Callable[[], Appearance]:
        patches = [patch for picture in self._patches for patch in picture]

        def run() -> Appearance:
            self._estimate = estimate_appearance(
                patches, now, self._world_from_camera, self._assume_bent
            )
            if self._estimate is None:
                return now
            fused = self._fused(self._estimate)
            self._misfit = _typical_misfit(patches, fused)
            return fused

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


def _typical_misfit(patches: Sequence[BallPatch], appearance: Appearance) -> float:
    """Geometric mean of the misfits of patches with enough clear rays; NaN without any."""
    clear = clear_patches(patches)
    return float(np.exp(np.mean(np.log(misfits(clear, appearance))))) if clear else np.nan


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

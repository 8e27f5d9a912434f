"""Search windows and gates: each ball predicted with covariance, and which detections agree.

Every ball is predicted in every image at its own time. Detections are to agree with the prediction
and with each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.estimation.losses import tukey_weights
from measure.estimation.multiview import calibration_noise
from measure.geometry import RigidTransform, propagate, squared_mahalanobis
from measure.measuring.tracking.motion_filter import (
    MotionState,
    displacement,
    propagated_covariance,
)
from measure.model import Body, Camera, Detection, Expectation, Rig
from measure.model.observations import Reason, stacked_detections

_OUT_OF_SIGHT_PX = -1e4
_NEAREST_RADII = 1.05  # Of a ball's centre from a camera: any nearer it has no outline


class GatedObservations(NamedTuple):
    """n detections to be gated."""

    pixels: Floats  # (n, 2) centres
    noise: Floats  # (n, 2, 2) covariances
    times_s: Floats  # (n,)
    colored: Bools  # (n,) whether the colour is right, or not checked


class PredictedBalls(NamedTuple):
    """n predicted ball-views, all balls of the first camera, then of the second, and so on."""

    centers_px: Floats  # (n, 2)
    radii_px: Floats  # (n,)
    centers_camera: Floats  # (n, 3) in mm
    covariances_px: Floats  # (n, 2, 2) from the predicted pose's covariance
    jacobians: Floats  # (n, 2, 6) by the pose's `perturb` chart
    max_sd_px: Floats  # (n,) largest standard deviation of the centre over all directions


def predict_balls(
    state: MotionState, leads_s: Floats, variance: Floats, body: Body, cameras: Sequence[Camera]
) -> PredictedBalls:
    """Every ball of a moving body in every one of c cameras, at its image's time.

    Args:
        leads_s: (c,) times of the images after the state's.
        variance: (6,) of the acceleration.
    """
    views, count = Rig.of([camera for camera in cameras for _ in body.balls]), len(body.balls)
    moved, velocities = displacement(state.kinematics, leads_s)
    turns = RigidTransform.from_rotvec(moved[:, 3:]).rotation
    arms = state.world_from_body.rotate(body.centers) @ np.swapaxes(turns, 1, 2)
    arms = arms.reshape(-1, 3)
    moves = np.repeat(moved[:, :3], count, axis=0)
    centers = arms + state.world_from_body.translation + moves
    pixels, by_point = views.project(centers)
    away = centers - views.centers
    jacobians = np.concatenate([by_point, np.cross(arms[:, None], by_point)], axis=2)
    radii = np.tile(body.radii, len(cameras))
    apart = np.linalg.norm(away, axis=1)
    inside = apart < _NEAREST_RADII * radii  # a prediction that has run into the camera
    behind = -_NEAREST_RADII * views.rows.rotation[:, :, 2]
    away[inside] = (radii[:, None] * behind)[inside]  # where no detector finds it
    unseen = np.isnan(pixels[:, 0]) | inside
    pixels[unseen], jacobians[unseen] = _OUT_OF_SIGHT_PX, 0.0
    row_s, middle = np.repeat(_readouts(tuple(cameras)), count, axis=0).T
    by_time = np.einsum("nui,ni->nu", jacobians, np.repeat(velocities, count, axis=0))
    pixels += (row_s * (pixels[:, 1] - middle))[:, None] * by_time
    known = propagated_covariance(state.covariance, leads_s, variance)[:, :6, :6]
    covariances = propagate(jacobians, np.repeat(known, count, axis=0))
    depth = np.sqrt(np.maximum(np.sum(away**2, axis=1) - radii**2, 1.0))
    return PredictedBalls(
        pixels,
        views.focal_px * radii / depth,
        np.einsum("nji,nj->ni", views.rows.rotation, away),
        covariances,
        jacobians,
        _largest_sd(covariances),
    )


def _largest_sd(covariances: Floats) -> Floats:
    """Largest standard deviations (n,) over all directions, by covariances (n, 2, 2)."""
    xx, yy, xy = covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 0, 1]
    return np.sqrt(np.maximum((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy), 0.0))


_DECIMALS = 7
"""Of px and mm passed to detectors.

Detectors choose between rays and edges that tie in 8-bit images; without this the last bits of
sums, which depend on their order, would decide.
"""


@dataclass(frozen=True, eq=False, slots=True)
class SearchWindows:
    """Predictions of n ball-views."""

    keys: tuple[tuple[str, str], ...]  # (camera, ball) of each
    balls: PredictedBalls  # the predictions, in the same order
    systematic_px2: Floats  # (n, 2, 2) covariances by the calibration and by the body's tolerance

    def expectations(
        self, sigmas: float, floor_px: float, radius_slack: float
    ) -> dict[str, list[Expectation]]:
        """For detectors, by camera.

        Args:
            sigmas: how many standard deviations of the prediction to search.
            floor_px: least reach of a search.
            radius_slack: largest relative error of the outline's radius.
        """
        b = self.balls
        reach = sigmas * b.max_sd_px + floor_px
        distance = np.maximum(np.linalg.norm(b.centers_camera, axis=1), 1e-9)
        radii = b.radii_px * (1 + np.outer([-1, 1], radius_slack + reach / distance))
        sizes = np.column_stack([b.centers_px, b.centers_camera, *radii, b.radii_px / 2, reach])
        sizes = sizes.round(_DECIMALS)
        out: dict[str, list[Expectation]] = {camera: [] for camera, _ in self.keys}
        rows = zip(self.keys, sizes[:, :2], sizes[:, 2:5], sizes[:, 5:].tolist(), strict=True)
        for (camera, ball), pixel, place, (low, high, apart, around) in rows:
            out[camera].append(Expectation(ball, pixel, (low, high), apart, around, 1.0, place))
        return out

    def observations(
        self, rows: Sequence[int], detections: Sequence[Detection], min_color_match: float
    ) -> GatedObservations:
        """Detections for the gates: their covariances include calibration and body tolerance.

        Args:
            rows: (n,) the prediction that each of them belongs to.
            detections: n of them.
            min_color_match: least share of a ball's inside that has its colour.
        """
        pixels, noise = stacked_detections(tuple(detections))
        return GatedObservations(
            pixels,
            noise + self.systematic_px2[rows],
            np.array([d.time_s for d in detections]),
            np.array([not d.color_match < min_color_match for d in detections]),
        )


def predict_windows(
    state: MotionState,
    times_s: Mapping[str, float],
    acceleration_sd: Floats,
    body: Body,
    cameras: Sequence[Camera],
) -> SearchWindows:
    """Predict every ball in every camera that has an image.

    Args:
        times_s: of the images, by camera name.
        acceleration_sd: (6,) as in `MotionState.at`.
        cameras: all cameras; those without an image are left out.
    """
    present = tuple(camera for camera in cameras if camera.name in times_s)
    rig = Rig.of(present)
    leads_s = np.array([times_s[camera.name] - state.time_s for camera in present])
    balls = predict_balls(state, leads_s, acceleration_sd**2, body, present)
    noise = calibration_noise(rig, state.world_from_body.apply(body.middle))
    systematic = np.repeat(noise, len(body.balls), axis=0)
    if body.tolerance_mm:
        px_per_mm = balls.radii_px / np.tile(body.radii, len(present))
        systematic += (body.tolerance_mm * px_per_mm)[:, None, None] ** 2 * np.eye(2)
    return SearchWindows(_keys(present, body), balls, systematic)


@lru_cache(maxsize=64)
def _keys(cameras: tuple[Camera, ...], body: Body) -> tuple[tuple[str, str], ...]:
    """Both compare by identity."""
    return tuple((camera.name, ball) for camera in cameras for ball in body.names)


@lru_cache(maxsize=64)
def _readouts(cameras: tuple[Camera, ...]) -> Floats:
    """Time in s from one row to the next, and the middle row, of c cameras: (c, 2)."""
    heights = [camera.intrinsics.size_wh[1] for camera in cameras]
    rows = [(c.readout_s / h, (h - 1) / 2) for c, h in zip(cameras, heights, strict=True)]
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


_ITERATIONS = 4


def gate_observations(
    seen: GatedObservations,
    rows: Ints,
    balls: PredictedBalls,
    covariance: Floats,
    time_s: float,
    variance: Floats,
    systematic_px: float,
    gate: float,
) -> tuple[list[Reason], tuple[Floats, Floats] | None]:
    """Gate detections, and estimate the change of the motion that the accepted ones ask for.

    Args:
        rows: (n,) the prediction that each of them belongs to.
        covariance: (12, 12) of pose and velocity at `time_s`.
        time_s: the instant that is predicted from.
        variance: (6,) of the acceleration.
        systematic_px: systematic error of a detection, added to its standard deviation.
        gate: greatest squared Mahalanobis distance, from a chi-square distribution of 2 degrees.

    Returns:
        Why each (n,) is suspended, or `Reason.NONE`; and the change of the velocity (6,) that the
        usable ones ask for with its covariance (6, 6), None if there are none.
    """
    off, noise = seen.pixels - balls.centers_px[rows], seen.noise + systematic_px**2 * np.eye(2)
    near = squared_mahalanobis(off, balls.covariances_px[rows] + noise) <= gate
    out = [Reason.COLOR if ok else Reason.JUMPED for ok in near.tolist()]
    usable = np.flatnonzero(near & seen.colored)
    if not len(usable):
        return out, None
    instant = float(np.mean(seen.times_s))
    slopes, lead_s = balls.jacobians[rows[usable]], seen.times_s[usable] - instant
    agreeing, change, known = agree_with_each_other(
        off[usable],
        np.concatenate([slopes, slopes * lead_s[:, None, None]], axis=2),
        noise[usable],
        propagated_covariance(covariance, instant - time_s, variance),
        gate,
    )
    for i, ok in zip(usable.tolist(), agreeing.tolist(), strict=True):
        out[i] = Reason.NONE if ok else Reason.INCONSISTENT
    return out, (change[6:], known[6:, 6:])


def agree_with_each_other(
    innovations: Floats, slopes: Floats, noise: Floats, prior: Floats, gate: float
) -> tuple[Bools, Floats, Floats]:
    """Whether one small change of the predicted pose and velocity explains innovations (n, 2).

    A robust linear update of the prediction (Tukey's weights). The residuals are compared with the
    detections' own noise, so a camera or ball that contradicts the majority fails the gate.

    Args:
        innovations: detected minus predicted centres, px.
        slopes: (n, 2, 12) of the centres by the pose's chart and the velocity.
        noise: (n, 2, 2) covariances of the detections.
        prior: (12, 12) covariance of the predicted pose and velocity at a common instant.
        gate: greatest squared Mahalanobis distance.

    Returns:
        Which are explained (n,), the change (12,), and its covariance (12, 12).
    """
    precision, information = np.linalg.inv(noise), np.linalg.inv(prior)
    distances, width = np.zeros(len(innovations)), 16.0 * gate
    for _ in range(_ITERATIONS):
        weights = tukey_weights(distances / width, 1.5)
        weighted = np.swapaxes(slopes, 1, 2) @ (precision * weights[:, None, None])
        covariance = np.linalg.inv(information + (weighted @ slopes).sum(axis=0))
        change = covariance @ np.einsum("nij,nj->i", weighted, innovations)
        left = innovations - slopes @ change
        distances = np.einsum("ni,nij,nj->n", left, precision, left)
        width = max(gate, width / 4)
    return distances <= gate, change, covariance

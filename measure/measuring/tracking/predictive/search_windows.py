"""Search windows: every ball predicted in every image at its own time, with covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from measure.arrays import Bools, Floats
from measure.compiling import compiled
from measure.estimation.multiview import calibration_noise
from measure.geometry.rotation_kernels import apply_matrix, rotation_of
from measure.measuring.tracking.predictive.motion_filter import (
    FilterState,
    MotionState,
    displacement,
    propagated_covariance,
)
from measure.model import Body, Camera, Detection, Expectation, Rig
from measure.model.observations import stacked_detections
from measure.model.rig import RigRows
from measure.model.rig_kernels import project_one

_OUT_OF_SIGHT_PX = -1e4


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


@compiled
def predict_balls(
    state: FilterState,
    variance: Floats,
    leads_s: Floats,
    balls: Floats,
    radii: Floats,
    rig: RigRows,
    readouts: Floats,
) -> PredictedBalls:
    """Every ball of a moving body in every camera, at its image's time.

    Args:
        variance: (6,) of the acceleration.
        leads_s: (c,) times of the images after the state's.
        balls: (k, 3) centres in the body.
        radii: (k,) mm.
        rig: the c cameras.
        readouts: (c, 2) time in s from one row to the next, and the middle row.
    """
    count = len(balls)
    out = _empty_predictions(len(rig.lenses) * count)
    by_point, toward = np.empty((2, 3)), np.empty(3)
    for camera in range(len(rig.lenses)):
        dt = leads_s[camera]
        known = propagated_covariance(state.covariance, dt, variance)
        moved, velocity = displacement(state.kinematics, dt)
        turned = rotation_of(moved[3:]) @ state.rotation
        for ball in range(count):
            row = camera * count + ball
            arm = apply_matrix(turned, balls[ball])
            center = arm + state.translation + moved[:3]
            pixel = out.centers_px[row]
            project_one(rig, camera, center, pixel, by_point)
            toward[:] = center - rig.centers[camera]
            out.centers_camera[row] = apply_matrix(rig.rotation[camera].T, toward)
            out.radii_px[row] = _radius_px(rig.lenses[camera], toward, radii[ball])
            if np.isfinite(pixel[0]) and np.isfinite(pixel[1]):
                _fill_jacobian(by_point, arm, out.jacobians[row])
                _add_row_delay(readouts[camera], velocity, out.jacobians[row], pixel)
            else:
                pixel[:] = _OUT_OF_SIGHT_PX
            _fill_covariance(row, known, out)
    return out


@compiled
def _empty_predictions(n: int) -> PredictedBalls:
    return PredictedBalls(
        np.zeros((n, 2)),
        np.zeros(n),
        np.zeros((n, 3)),
        np.zeros((n, 2, 2)),
        np.zeros((n, 2, 6)),
        np.zeros(n),
    )


@compiled
def _radius_px(lens: Floats, toward: Floats, radius: float) -> float:
    """The radius in px of the tangent cone's cross-section at right angles to its axis."""
    square = toward[0] ** 2 + toward[1] ** 2 + toward[2] ** 2
    return (lens[0] + lens[3]) / 2 * radius / np.sqrt(max(square - radius**2, 1.0))


@compiled
def _fill_jacobian(by_point: Floats, arm: Floats, slopes: Floats) -> None:
    """Jacobian (2, 6) of a ball's pixel by the pose; rotations act by the arm's cross product."""
    for u in range(2):
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            slopes[u, a] = by_point[u, a]
            slopes[u, 3 + a] = arm[b] * by_point[u, c] - arm[c] * by_point[u, b]


@compiled
def _add_row_delay(readout: Floats, velocity: Floats, slopes: Floats, pixel: Floats) -> None:
    """Move a pixel to where it is when a rolling shutter exposes its row."""
    delay = readout[0] * (pixel[1] - readout[1])
    for u in range(2):
        for a in range(6):
            pixel[u] += delay * slopes[u, a] * velocity[a]


@compiled
def _fill_covariance(row: int, known: Floats, out: PredictedBalls) -> None:
    """A pixel's covariance from the pose's, and its largest standard deviation."""
    slopes, covariance = out.jacobians[row], out.covariances_px[row]
    for u in range(2):
        for v in range(2):
            total = 0.0
            for i in range(6):
                for j in range(6):
                    total += slopes[u, i] * known[i, j] * slopes[v, j]
            covariance[u, v] = total
    half = (covariance[0, 0] - covariance[1, 1]) / 2
    largest = (covariance[0, 0] + covariance[1, 1]) / 2 + np.sqrt(
        half**2 + covariance[0, 1] * covariance[1, 0]
    )
    out.max_sd_px[row] = np.sqrt(max(largest, 0.0))


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
    balls = predict_balls(
        state.filter_state(),
        acceleration_sd**2,
        np.array([times_s[camera.name] - state.time_s for camera in present]),
        body.centers,
        body.radii,
        rig.rows,
        _readouts(present),
    )
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

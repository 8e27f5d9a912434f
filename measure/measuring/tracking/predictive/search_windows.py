"""Search windows: every ball predicted in every image at its own time, with covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from measure.arrays import Floats
from measure.estimation.multiview import calibration_noise
from measure.measuring.tracking.predictive.ball_projection import (
    PredictedBalls,
    predict_balls,
    search_sizes,
)
from measure.measuring.tracking.predictive.gating import GatedObservations
from measure.measuring.tracking.predictive.motion_filter import MotionState
from measure.model import Body, Camera, Detection, Expectation, Rig
from measure.model.observations import stacked_detections

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
        sizes = search_sizes(self.balls, sigmas, floor_px, radius_slack, _DECIMALS)
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

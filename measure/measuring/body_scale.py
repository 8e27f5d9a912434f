"""A common factor between the balls' measured distances and those of the body file.

The balls' positions come from rays alone. If all lie too far apart by one factor, the scale of the
calibration or the lengths of the body file are off; the pose, in which the body is rigid, hides it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from measure.limits import SIGNIFICANT_SIGMAS
from measure.measuring.measurement import Measurement
from measure.model import BallPosition, Body, Pose
from measure.model.observations import stacked_positions

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
        flag = (
            f"the balls are {1 + off:.4f} +- {sd:.4f} times as far apart as the body file says: "
            "the body file or the calibration is off"
        )
        return measured.flagged(flag)

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

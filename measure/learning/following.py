"""True poses that come now and then: a Kalman filter follows the offsets of joints and base."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Correction
from measure.learning.zeroing import PRIOR_SD_MM
from measure.robots import StateSchema

MEMORY_S = 24.0  # offsets fade with this time constant: hysteresis lasts as long
_HOLD_S = 0.02  # the offset at the tip is computed anew after this time: at 1 kHz it hardly changes
_LEAST_LEVER_MM = 5.0  # of a joint at the first pose, which scales its offset


class OffsetFollower:
    """Offsets (joints, if known, and base) that fade to zero, corrected by every true pose.

    The stated covariance of the model holds offsets of unseen recordings already: it is left as
    it is, and is that of the measurement. The drift monitor takes the innovations.
    """

    def __init__(self, schema: StateSchema, prior_sd_mm: float = PRIOR_SD_MM) -> None:
        self.monitor = DriftMonitor()
        self._schema, self._prior = schema, prior_sd_mm**2
        self._lever: Floats | None = None
        self.forget()

    def forget(self) -> None:
        """The robot was started again: its offsets are others."""
        self._mean: Floats | None = None
        self._time_s = self._held_s = np.nan

    def corrected(self, correction: Correction, state: Floats, time_s: float) -> Correction:
        """A model's correction with the offset at a state (features,)."""
        if self._mean is None:
            return correction
        if not 0 <= time_s - self._held_s < _HOLD_S:
            self._fade(time_s)
            self._offset_mm, self._held_s = self._design(state) @ self._mean, time_s
        error = correction.error_mm + self._offset_mm
        return Correction(error, correction.covariance, correction.unfamiliar)

    def add(
        self,
        correction: Correction,
        state: Floats,
        time_s: float,
        true_mm: Floats,
        covariance: Floats,
    ) -> None:
        """Take the true position (3,) at a state that the model corrected so."""
        design, self._held_s = self._design(state), np.nan
        if self._mean is None:
            self._mean, self._spread = (
                np.zeros(design.shape[1]),
                self._prior * np.eye(design.shape[1]),
            )
            self._time_s = time_s
        self._fade(time_s)
        reported = self._schema.position_mm(state)
        innovation = true_mm - reported - correction.error_mm - design @ self._mean
        across = self._spread @ design.T
        stated = design @ across + correction.covariance + covariance
        self.monitor.add(innovation, stated)
        gain = np.linalg.solve(stated, across.T).T
        self._mean = self._mean + gain @ innovation
        self._spread = self._spread - gain @ across.T

    def _fade(self, time_s: float) -> None:
        """Bring the offsets to an instant; a stamp that is unknown or earlier changes nothing."""
        past = time_s - self._time_s
        if self._mean is None or not past > 0:
            return
        kept = float(np.exp(-past / MEMORY_S))
        self._mean = kept * self._mean
        fresh = (1.0 - kept**2) * self._prior * np.eye(len(self._mean))
        self._spread = kept**2 * self._spread + fresh
        self._time_s = time_s

    def _design(self, state: Floats) -> Floats:
        """Motion (3, offsets) of the tip by an offset of 1 mm of each joint and of the base."""
        chain = self._schema.chain
        if chain is None:
            return np.eye(3)
        jacobian = chain.jacobian(self._schema.joint_positions(state))[:3]
        if self._lever is None:
            self._lever = np.maximum(np.linalg.norm(jacobian, axis=0), _LEAST_LEVER_MM)
            slides = [joint.prismatic for joint in chain.joints]
            self._lever = np.where(slides, 1.0, self._lever)
        return np.concatenate([jacobian / self._lever, np.eye(3)], axis=1)


@dataclass
class DriftMonitor:
    """Detects changed cables: measured residuals that no longer fit the stated covariance.

    The squared Mahalanobis length of a residual per axis is 1 on average if they fit. Its
    exponential average is compared with a limit.
    """

    # of the average, beyond which retraining is due; 2 means residuals 1.4 times as large as
    # stated.
    limit: float = 2.0
    memory: float = 500.0  # labels over which to average
    ratio: float = 1.0
    count: int = 0

    def add(self, residual_mm: Floats, covariance: Floats) -> None:
        """Add one measured residual and its stated covariance."""
        squared = float(residual_mm @ np.linalg.solve(covariance, residual_mm)) / 3.0
        self.count += 1
        share = max(1.0 / self.count, 1.0 / self.memory)
        self.ratio += share * (min(squared, 50.0) - self.ratio)

    @property
    def due(self) -> bool:
        """Whether retraining is due."""
        return self.count >= min(100.0, self.memory) and self.ratio > self.limit

    def sentence(self) -> str:
        """For people."""
        size = self.ratio**0.5
        if self.count < 100:
            return f"drift: only {self.count} measured states, too few to judge"
        if self.due:
            return (
                f"drift: residuals are {size:.2f} times as large as promised: "
                "the cables have changed, train again"
            )
        return f"drift: none, residuals are {size:.2f} times as large as promised"

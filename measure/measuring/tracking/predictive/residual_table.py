"""One table of a pose's residuals, and one rule: what all sightings of a ball or a camera share.

A fit adapts to an error that the sightings of one ball or one camera share, and suspends what it
cannot adapt to. Both remain visible where sightings are grouped: the group lies elsewhere than
predicted, or its residuals have one direction.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Literal

import numpy as np

from measure.arrays import Floats
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile, propagate, squared_mahalanobis
from measure.limits import TINY
from measure.model import BallView, Body, Camera, Detection, Motion, Pose, Rig
from measure.model.observations import Reason

By = Literal["ball", "camera"]
ELSEWHERE = (Reason.INCONSISTENT, Reason.JUMPED)
"""Reasons of a ball detected at another place than predicted."""
_MIN_SIGHTINGS = 2


@dataclass(frozen=True, eq=False)
class ResidualTable:
    """The sightings of one frame set: those elsewhere, and what the effective ones are off by."""

    pose: Pose
    views: Sequence[BallView]  # with effective and suspended detections
    residuals_px: Mapping[tuple[str, str], Floats]  # (2,), by (ball, camera)
    body: Body
    cameras: Sequence[Camera]
    view_bias_px: float  # standard deviation of a ball-view's own bias in addition to its noise

    @cached_property
    def effective(self) -> tuple[Detection, ...]:
        """The detections that were used."""
        return tuple(v.detection for v in self.views if v.effective and v.detection is not None)

    @property
    def stated_rms_px(self) -> float:
        """RMS over both axes of what `effective` may be off by, stated and by calibration."""
        seen = [2 * d.variance_px2 + np.trace(self._noise[d.camera]) for d in self.effective]
        return float(np.sqrt(sum(seen) / max(len(seen), 1)))

    def elsewhere(self, by: By, reasons: Collection[Reason]) -> dict[str, list[BallView]]:
        """Detections suspended for one of `reasons`, by name of the ball or camera."""
        out = dict[str, list[BallView]]()
        for view in self.views:
            if view.reason in reasons and view.detection is not None:
                out.setdefault(attrgetter(by)(view), []).append(view)
        return out

    @cached_property
    def contradicting_cameras(self) -> tuple[str, ...]:
        """Cameras with two or more detections, all of them elsewhere than predicted."""
        seen = [view.camera for view in self.views if view.detection is not None]
        against = self.elsewhere("camera", ELSEWHERE)
        return tuple(
            name
            for name, some in against.items()
            if len(some) == seen.count(name) >= _MIN_SIGHTINGS
        )

    def shared_offsets(
        self, by: By, confidence: float, motion: Callable[[], Motion | None]
    ) -> Iterator[tuple[str, Floats]]:
        """Groups whose residuals share an offset that their uncertainties do not explain.

        That of a ball is its offset from the place that the pose gives it, (3,) in mm; that of
        a camera is where it sees all balls, (2,) in px.

        Args:
            motion: returns the motion by which detections were moved to one instant; rarely called.
        """
        seen, off_px, weights = self._rows
        names = [attrgetter(by)(d) for d in seen]
        groups = [g for g in dict.fromkeys(names) if names.count(g) >= _MIN_SIGHTINGS]
        if not groups:
            return
        columns = self._slopes if by == "ball" else np.broadcast_to(np.eye(2), (len(seen), 2, 2))
        size = columns.shape[2]
        weights = weights * np.array([[name == group for name in names] for group in groups])
        squares = np.swapaxes(columns, 1, 2) @ columns
        normal = (weights @ squares.reshape(len(seen), -1)).reshape(-1, size, size)
        normal += TINY * np.eye(size)  # Along a ray of all cameras nothing is known of a distance
        right = weights @ (off_px[:, None] @ columns)[:, 0]
        offsets = np.linalg.solve(normal, right[..., None])[..., 0]
        gate = chi_square_quantile(confidence, size)
        for group in np.flatnonzero((offsets * right).sum(axis=1) > gate).tolist():
            noise = np.linalg.inv(normal[group])
            gains = noise @ np.swapaxes(columns * weights[group, :, None, None], 1, 2)
            explained = noise + self._explained(gains, motion())
            if squared_mahalanobis(offsets[group], explained) > gate:
                yield groups[group], offsets[group]

    @cached_property
    def _rows(self) -> tuple[list[Detection], Floats, Floats]:
        """Effective detections, what they are off by (n, 2) in px, and their weights (n,)."""
        seen = [d for d in self.effective if (d.ball, d.camera) in self.residuals_px]
        off_px = [self.residuals_px[d.ball, d.camera] for d in seen]
        variances = np.array([d.variance_px2 for d in seen])
        return seen, np.array(off_px), 1 / (variances + self.view_bias_px**2)

    @cached_property
    def _slopes(self) -> Floats:
        """Derivatives (n, 2, 3) of sightings by the place of the middle; zero out of view."""
        rig = Rig.of(self.cameras)
        slopes = np.nan_to_num(rig.project(self._middle)[1])
        return slopes[[rig.names.index(d.camera) for d in self._rows[0]]]

    @cached_property
    def _middle(self) -> Floats:
        return self.pose.world_from_body.apply(self.body.middle)

    @cached_property
    def _noise(self) -> Mapping[str, Floats]:
        """What uncertain cameras add to a sighting (2, 2), px^2, by name of the camera."""
        rig = Rig.of(self.cameras)
        return dict(zip(rig.names, calibration_noise(rig, self._middle), strict=True))

    def _explained(self, gains: Floats, motion: Motion | None) -> Floats:
        """Covariance of an offset by the uncertainty of calibration, body file and motion.

        Detections are moved to one instant by a constant velocity, which is uncertain and changes.

        Args:
            gains: (n, k, 2) derivatives of the offset by the sightings.
        """
        seen, slopes = self._rows[0], self._slopes
        names = np.array([d.camera for d in seen])
        out = propagate(np.einsum("nki,nij->kj", gains, slopes), self.body.center_covariance)
        for camera, own in self._noise.items():
            out = out + propagate(gains[names == camera].sum(axis=0), own)
        if motion is None or motion.velocity_covariance is None:
            return out
        arm = self._middle - self.pose.world_from_body.translation
        lead_s = np.array([d.time_s - self.pose.time_s for d in seen])
        by_pose = gains @ np.concatenate([slopes, np.cross(arm, slopes)], axis=2)
        out = out + propagate(np.tensordot(lead_s, by_pose, 1), motion.velocity_covariance)
        if motion.acceleration_square is not None:
            left_out = np.tensordot(lead_s**2 / 2, by_pose, 1)
            out = out + propagate(left_out, motion.acceleration_square)
        return out

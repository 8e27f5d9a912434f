"""Flags of a solved pose: soft ones lower its status, hard ones also keep it out of the filter.

They come from one table of residuals, by camera, by ball and of the whole body. A fit adapts to an
error that the sightings of one ball or one camera share, and suspends what it cannot adapt to. Both
remain visible where sightings are grouped: the group lies elsewhere than predicted, or its
residuals have one direction.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Literal

import numpy as np

from measure.arrays import Floats
from measure.estimation.body_layout import layout_flags
from measure.estimation.multiview import calibration_noise
from measure.geometry import chi_square_quantile, propagate, squared_mahalanobis
from measure.limits import TINY
from measure.measuring.association import MIN_VIEWS
from measure.measuring.tracking.settings import PredictiveConfig
from measure.model import BallPosition, BallView, Body, Camera, Detection, Doubt, Motion, Pose, Rig
from measure.model.observations import Reason, stacked_positions

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


_MAX_CONTRADICTING_SHARE = 0.5
_RMS_SIGMAS = 2.0
_HOLD_FRAME_SETS = 10
"""Frame sets, after cameras contradicted each other, in which motion explains no offset."""
_ELSEWHERE_LATELY = (*ELSEWHERE, Reason.RECOVERING)
_ENOUGH = 2  # Sightings elsewhere, or blind cameras, that are no accident


class PoseChecks:
    """Flags the poses of one body since it was found.

    Motion does not explain an offset for some time after cameras contradicted each other: else a
    shaken body would hide from time to time that a camera was moved.
    """

    def __init__(self, config: PredictiveConfig) -> None:
        self._config, self._hold = config, 0
        self._confirmed: set[str] = set()
        self._disagreeing: tuple[str, ...] = ()

    def begin(self, disagreeing: tuple[str, ...]) -> None:
        """A search has found the body, with these cameras against it."""
        self._confirmed, self._disagreeing = set(), disagreeing

    def hard(self, table: ResidualTable, positions: Sequence[BallPosition]) -> tuple[str, ...]:
        """Flags of a wrong pose: ball distances, reprojection errors, contradicting cameras."""
        c, found = self._config, tuple[str, ...]()
        if len(positions) >= 2:
            found += layout_flags(
                table.body,
                [position.ball for position in positions],
                *stacked_positions(tuple(positions)),
                c.distance_tolerance_mm,
            )
        rms_px = table.pose.rms_px
        if rms_px > c.max_rms_px and rms_px > math.hypot(
            c.max_rms_px, _RMS_SIGMAS * table.stated_rms_px
        ):
            found += (Doubt("reprojection", rms_px=rms_px),)
        contradicting = table.contradicting_cameras
        used = {d.camera for d in table.effective} | set(contradicting)
        if contradicting and len(contradicting) >= _MAX_CONTRADICTING_SHARE * len(used):
            found += (Doubt("contradiction", cameras=contradicting),)
        return found

    def soft(
        self,
        table: ResidualTable,
        motion: Callable[[], Motion | None],
        new_at_s: Collection[float] = (),
    ) -> tuple[str, ...]:
        """Flags of a pose that is less certain than usual, or of cameras and balls to check.

        Args:
            motion: returns the motion by which detections were moved to one instant; rarely called.
            new_at_s: the instants of the images, if the body's velocity is still unknown.
        """
        self._hold = _HOLD_FRAME_SETS if table.contradicting_cameras else max(self._hold - 1, 0)
        known = motion if self._hold == 0 else lambda: None
        return (
            *_uncertain(table, self._config.max_sd_mm),
            *(Doubt("camera-contradicts", camera=name) for name in table.contradicting_cameras),
            *self._disagreement(table),
            *self._unconfirmed(table),
            *(_unstable_initialisation(table) if len(set(new_at_s)) > 1 else ()),
            *_balls_seen_elsewhere(table),
            *_shared_offsets(table, self._config.confidence, known),
            *single_view_balls(table),
        )

    def _disagreement(self, table: ResidualTable) -> Iterator[str]:
        """Cameras that disagreed with the search and still have no effective view."""
        agreeing = {d.camera for d in table.effective}
        self._disagreeing = tuple(name for name in self._disagreeing if name not in agreeing)
        for name in self._disagreeing:
            yield Doubt("camera-disagrees", camera=name)

    def _unconfirmed(self, table: ResidualTable) -> Iterator[str]:
        """Balls that no two cameras have seen at once since the body was found.

        Three balls alone fit a body whose fourth is elsewhere, and the mirror image, equally well.
        """
        if len(table.body.balls) <= 3:
            return
        seen = [d.ball for d in table.effective]
        self._confirmed |= {ball for ball in seen if seen.count(ball) >= _ENOUGH}
        for ball in table.body.names:
            if ball not in self._confirmed:
                yield Doubt("unconfirmed-ball", ball=ball)


def _balls_seen_elsewhere(table: ResidualTable) -> Iterator[str]:
    """Balls detected elsewhere by two cameras, or by as many as detect them where predicted.

    The edge that another ball leaves of one whose centre it hides contradicts nothing.
    """
    effective = [d.ball for d in table.effective]
    body, centers = table.body, table.pose.world_from_body.apply(table.body.centers)
    for ball, views in table.elsewhere("ball", _ELSEWHERE_LATELY).items():
        there, index = {view.camera for view in views}, body.index(ball)
        cameras = [camera for camera in table.cameras if camera.name in there]
        names = [camera.name for camera in cameras if _in_sight(camera, body, centers, index)]
        if len(names) >= min(_ENOUGH, max(effective.count(ball), 1)):
            yield Doubt("ball-elsewhere", ball=ball, cameras=names)


def _shared_offsets(
    table: ResidualTable, confidence: float, motion: Callable[[], Motion | None]
) -> Iterator[str]:
    """Balls and cameras whose residuals share an offset that their uncertainty does not explain."""
    for ball, off in table.shared_offsets("ball", confidence, motion):
        yield Doubt("ball-aside", ball=ball, off_mm=math.hypot(*off))
    for camera, off in table.shared_offsets("camera", confidence, motion):
        yield Doubt("camera-aside", camera=camera, off_px=math.hypot(*off))


def _uncertain(table: ResidualTable, max_sd_mm: float) -> Iterator[str]:
    """What little a pose rests on."""
    used = sorted({d.camera for d in table.effective})
    if len(used) == 1:
        yield Doubt("one-camera", camera=used[0])
    if len({d.ball for d in table.effective}) < 3:
        yield Doubt("two-balls")
    if not table.pose.position_sd_mm <= max_sd_mm:
        yield Doubt("uncertain", sd_mm=table.pose.position_sd_mm)
    if len(table.effective) < MIN_VIEWS:
        yield Doubt("few-sightings", sightings=len(table.effective))


def _unstable_initialisation(table: ResidualTable) -> Iterator[str]:
    """A flag if images of different times contradict each other about a body just found.

    Where two or more detections lie elsewhere than predicted, the others may have been moved to the
    common instant by a wrong velocity as well.
    """
    elsewhere = sum(map(len, table.elsewhere("ball", ELSEWHERE).values()))
    if elsewhere >= _ENOUGH:
        yield Doubt("just-found", sightings=elsewhere)


def single_view_balls(table: ResidualTable) -> Iterator[str]:
    """Balls that one camera alone sees, though others look where they should be."""
    seen = [d.ball for d in table.effective]
    count = {ball: seen.count(ball) for ball in table.body.names}
    # With three balls in two cameras each, the rotation rests on none of the others.
    if 1 not in count.values() or sum(n > 1 for n in count.values()) > 2:
        return
    centers = table.pose.world_from_body.apply(table.body.centers)
    for ball in (name for name in table.body.names if count[name] == 1):
        missing = {v.camera for v in table.views if v.ball == ball and v.reason is Reason.NOT_FOUND}
        blind = [
            camera.name
            for camera in table.cameras
            if camera.name in missing
            and _in_sight(camera, table.body, centers, table.body.index(ball))
        ]
        if len(blind) >= _ENOUGH:
            yield Doubt("hidden-ball", ball=ball, cameras=blind)


def _in_sight(camera: Camera, body: Body, centers: Floats, ball: int) -> bool:
    """Whether a ball lies in the image and its centre is hidden by no other ball of the body."""
    if not camera.intrinsics.contains(camera.project(centers[ball][None]))[0]:
        return False
    return not camera.hides(centers, body.radii)[ball].any()


def too_uncertain(pose: Pose, body: Body) -> bool:
    """Whether the standard deviation of the balls' places exceeds the smallest ball's radius.

    Windows would then be as large as the image and contain several balls: a search is faster and
    safer.
    """
    variances = pose.covariance.diagonal().tolist()
    move_mm2, turn2 = sum(variances[:3]), sum(variances[3:])
    return math.sqrt(move_mm2 + turn2 * body.reach_mm**2) > min(b.radius_mm for b in body.balls)

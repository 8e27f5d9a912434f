"""Effective or suspended: the paper's two states of one ball in one camera, as pure transitions.

Peng, Yang, Su, Hannaford (ICRA 2020), section II.D "Frame Update Algorithm".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from measure.arrays import Floats
from measure.model import Detection
from measure.model.observations import Reason, State

_RADIUS_MEMORY = 0.5
"""Weight of the earlier radius in the running mean: one noisy radius must not shift the bounds."""


@dataclass(frozen=True, eq=False)
class Circle:
    """The state of one ball in one camera."""

    state: State = State.EFFECTIVE
    reason: Reason = Reason.NONE  # why it is suspended; `Reason.NONE` if it is not
    good_frames: int = 0  # for how many frames in a row a suspended circle has been good
    center_px: Floats | None = None  # (2,) where it was last accepted, None before the first time
    radius_px: float | None = None  # its radius then, smoothed
    time_s: float | None = None  # when that was

    @property
    def effective(self) -> bool:
        """Whether it may be used."""
        return self.state is State.EFFECTIVE


@dataclass(frozen=True)
class CircleEvidence:
    """The checks of one circle in one frame."""

    found: bool  # Hough returned a circle, at the latest with the largest tolerable sigma
    color_ok: bool = True
    # its centre moved more than the motion threshold since the last frame.
    moved_too_far: bool = False
    # whether it agrees with the 3-D centre from effective circles; None if fewer than two others
    # are effective, so that there is no such centre.
    consistent: bool | None = None


def advance(circle: Circle, evidence: CircleEvidence, good_frames_needed: int) -> Circle:
    """The circle's state after one more frame.

    An effective circle is suspended by any of the paper's three causes, or because it disagrees
    with the other cameras' circles (not in the paper: else a steady false circle would stay
    effective for ever). A suspended one becomes effective after *more* than `good_frames_needed`
    good frames in a row: found, of the right colour, and consistent with the effective circles in
    3-D.
    """
    reason = _suspension_reason(circle, evidence)
    if reason is not Reason.NONE:
        return replace(circle, state=State.SUSPENDED, reason=reason, good_frames=0)
    if circle.effective:
        return circle
    # A frame in which the circle cannot be checked interrupts the run of good frames.
    good_frames = circle.good_frames + 1 if evidence.consistent else 0
    if good_frames > good_frames_needed:
        return replace(circle, state=State.EFFECTIVE, reason=Reason.NONE, good_frames=0)
    return replace(circle, reason=Reason.RECOVERING, good_frames=good_frames)


def _suspension_reason(circle: Circle, evidence: CircleEvidence) -> Reason:
    if not evidence.found:
        return Reason.NOT_FOUND
    if not evidence.color_ok:
        return Reason.COLOR
    if circle.effective and evidence.moved_too_far:
        return Reason.JUMPED
    if evidence.consistent is False:
        return Reason.INCONSISTENT
    return Reason.NONE


def remember(circle: Circle, detection: Detection) -> Circle:
    """The circle with the detection's centre, time and averaged radius."""
    radius = detection.radius_px
    if circle.radius_px is not None:
        radius = _RADIUS_MEMORY * circle.radius_px + (1 - _RADIUS_MEMORY) * radius
    return replace(circle, center_px=detection.center_px, radius_px=radius, time_s=detection.time_s)

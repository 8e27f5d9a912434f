"""The result of the pipeline for one frame set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

from measure.arrays import Floats
from measure.estimation.expected_accuracy import tolerance_covariance
from measure.model import BallPosition, BallView, Body, Pose

if TYPE_CHECKING:
    from measure.measuring.kept_rig import KeptRig
    from measure.measuring.time_alignment import FrameSetObservations


class Status(StrEnum):
    """How a frame set ended."""

    OK = "ok"
    FLAGGED = "flagged"
    LOST = "lost"
    SKIPPED = "skipped"


@dataclass(frozen=True, eq=False)
class Measurement:
    """One frame set, measured."""

    index: int  # number of the frame set in the session
    time_s: float  # the instant the positions and the pose hold for
    frames: dict[str, int]  # frame number of each camera's image, by camera name
    # the state of every ball in every camera, with its detection if there is one.
    views: tuple[BallView, ...]
    positions: tuple[BallPosition, ...]  # at most one per ball
    pose: Pose | None  # the body's pose, None unless `status` is OK or FLAGGED
    status: Status  # OK; FLAGGED (a pose with flags); LOST (no pose); SKIPPED (not tried)
    reason: str = ""  # why it is not OK, in words; empty otherwise
    # by (ball, camera), detected minus predicted centre (2,) in px, for every effective view of a
    # frame set with a pose.
    residuals_px: dict[tuple[str, str], Floats] = field(default_factory=dict)
    # names of the cameras in which the whole frame was searched for some ball.
    searched: tuple[str, ...] = ()
    # cameras that show another camera's images, and are left out, with that one's name.
    copies: Mapping[str, str] = field(default_factory=dict)
    repeated: tuple[str, ...] = ()  # cameras that show their last image again
    # the cameras as they were used, where it is kept which were moved meanwhile.
    rig: KeptRig | None = None

    @property
    def doubts(self) -> str:
        """Why it is not OK, its pose's flags included; empty otherwise."""
        flags = () if self.pose is None else self.pose.flags
        return "; ".join(dict.fromkeys(filter(None, (self.reason, *flags))))

    def flagged(self, flag: str) -> Measurement:
        """The same with one more flag of its pose, if it has one."""
        if self.pose is None:
            return self
        pose = replace(self.pose, flags=(*self.pose.flags, flag))
        return replace(self, pose=pose, status=Status.FLAGGED)

    def without_images(self, copies: Mapping[str, str], repeated: Sequence[str]) -> Measurement:
        """The same, saying whose images are left out and why: a pose without them is no worse."""
        said = [f"{copy} shows the pictures of {whose}" for copy, whose in copies.items()]
        said += [f"{name} repeats its last picture" for name in repeated]
        same = replace(self, copies=dict(copies), repeated=tuple(repeated))
        return same.noted("; ".join(said))

    def noted(self, text: str) -> Measurement:
        """The same with one more reason, which leaves its status as it is."""
        return replace(self, reason="; ".join(filter(None, (self.reason, text))))

    def with_tolerance(self, body: Body) -> Measurement:
        """The same, with the body's tolerance added to the pose's covariance: no image shows it."""
        pose = self.pose
        if pose is None or not body.tolerance_mm:
            return self
        share = tolerance_covariance(body, pose.world_from_body, pose.balls)
        return replace(self, pose=replace(pose, covariance=pose.covariance + share))


@dataclass(frozen=True, eq=False, slots=True)
class Draft:
    """A measurement that may be solved again when later poses are known."""

    measurement: Measurement
    # flags of its pose that the tracker or the pipeline raised, not the solver.
    tracker_flags: tuple[str, ...]
    # the observations it rests on; None if the frame set was skipped.
    seen: FrameSetObservations | None = None

    def flagged(self, flag: str) -> Draft:
        """The same with one more flag of its pose, if it has one."""
        if self.measurement.pose is None:
            return self
        flags = (*self.tracker_flags, flag)
        return replace(self, measurement=self.measurement.flagged(flag), tracker_flags=flags)

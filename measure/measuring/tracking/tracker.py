"""The contract between the pipeline and a way of tracking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from measure.arrays import Floats
from measure.model import BallPosition, BallView, Detection, Expectation, FrameSet, Motion, Pose
from measure.records import record


@record
class Verdict:
    """Whether a pose is believed: the pose (maybe with flags added) or None, and why in words."""

    pose: Pose | None
    reason: str = ""


class Tracker(Protocol):
    """Holds the state between frame sets; called in this order for each of them.

    `expect` -> (detectors run) -> `judge` -> (triangulator, solver) -> `conclude`.
    """

    def warm_up(self) -> None:
        """Compile or load what is slow, before the first frame set."""

    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]] | None:
        """Where each camera should look for each ball, by camera name.

        A ball without an expectation is searched for in the whole frame; an empty mapping searches
        everything. None: this frame set is skipped (the paper's "skips a few frames and restarts").
        """

    def backwards(self) -> Tracker | None:
        """One that knows what this one does, for frame sets before the last; None if none can."""

    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """The state of every ball in every camera, each with at most one detection."""

    def motion(self, time_s: float) -> Motion | None:
        """Where the body is expected around `time_s` and how fast it moves, if known."""

    def conclude(
        self,
        frame_set: FrameSet,
        views: Sequence[BallView],
        positions: Sequence[BallPosition],
        pose: Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Verdict:
        """Learn from the result, and say whether the pose is believed.

        Args:
            frame_set: the pictures.
            views: as judged.
            positions: of the effective views.
            pose: as solved.
            residuals_px: by (ball, camera), detected minus predicted centre (2,) of every effective
                view; empty without a pose.
        """

"""The interface of a tracker: the state that the pipeline keeps between frame sets."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from measure.arrays import Floats
from measure.host.interfaces import Plugin
from measure.host.settings import Settings
from measure.model import (
    BallPosition,
    BallView,
    Body,
    Camera,
    Detection,
    Expectation,
    FrameSet,
    Motion,
    Pose,
)

Review = Callable[[Mapping[str, Sequence[Detection]]], None]
"""Takes the detections of whole images by camera name; what follows holds from the next on."""


@dataclass(frozen=True, eq=False, slots=True)
class Conclusion:
    """An accepted pose, perhaps with flags added and a note, or None and the reason in words."""

    pose: Pose | None  # accepted
    reason: str = ""  # why there is none; with a pose, a note that is no doubt of it


class Tracker(Plugin):
    """Holds the state between frame sets; the pipeline calls its methods in this order for each.

    `expect` -> (detectors) -> `judge` -> `motion` -> (triangulator, solver) -> `conclude`.
    """

    def __init__(self, config: Settings, body: Body, cameras: Sequence[Camera]) -> None:
        self.config = config
        self.body = body
        self.cameras = tuple(cameras)

    def use_cameras(self, cameras: Sequence[Camera]) -> None:
        """From now on cameras of the same names stand elsewhere: one was moved, and is known anew.

        A tracker that keeps more of its cameras than `self.cameras` overrides this.
        """
        self.cameras = tuple(cameras)

    @abstractmethod
    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]] | None:
        """Where each ball is expected in each camera, by camera name.

        A ball without an expectation is searched for in the whole frame, all of them if the mapping
        is empty. None: this frame set is skipped (the paper's "skips a few frames and restarts").
        """

    def doubt(self, frame_set: FrameSet) -> Review | None:  # noqa: ARG002
        """Takes what whole images show, to settle a doubt; None without one. After `conclude`."""
        return None

    @abstractmethod
    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """The state of every ball in every camera, each with at most one detection."""

    @abstractmethod
    def motion(self, time_s: float) -> Motion | None:
        """The predicted pose and velocity around `time_s`; None if unknown."""

    @abstractmethod
    def conclude(
        self,
        frame_set: FrameSet,
        views: Sequence[BallView],
        positions: Sequence[BallPosition],
        pose: Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],
    ) -> Conclusion:
        """Update the state with the result, and accept, flag or refuse the pose.

        Args:
            views: as returned by `judge`.
            positions: from the effective views.
            residuals_px: by (ball, camera), detected minus predicted centre (2,) of every effective
                view; empty without a pose.
        """

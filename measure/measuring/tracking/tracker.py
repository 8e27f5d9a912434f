"""The interface between the pipeline and a tracker; and the one that remembers nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from measure import model
from measure.arrays import Floats
from measure.host.settings import Settings
from measure.model import BallPosition, BallView, Detection, Expectation, FrameSet, Motion, Pose
from measure.model.observations import Reason, State

Review = Callable[[Mapping[str, Sequence[Detection]]], None]
"""Takes the detections of whole images by camera name; what follows holds from the next on."""


@dataclass(frozen=True, eq=False, slots=True)
class Conclusion:
    """An accepted pose, perhaps with flags added, or None and the reason in words."""

    pose: Pose | None
    reason: str = ""


class Tracker(Protocol):
    """Holds the state between frame sets; the pipeline calls its methods in this order for each.

    `expect` -> (detectors) -> `judge` -> `motion` -> (triangulator, solver) -> `conclude`.
    """

    def warm_up(self) -> None:
        """Compile or load what is slow, before the first frame set."""

    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]] | None:
        """Where each ball is expected in each camera, by camera name.

        A ball without an expectation is searched for in the whole frame, all of them if the mapping
        is empty. None: this frame set is skipped (the paper's "skips a few frames and restarts").
        """

    def doubt(self, frame_set: FrameSet) -> Review | None:
        """Takes what whole images show, to settle a doubt; None without one. After `conclude`."""

    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        """The state of every ball in every camera, each with at most one detection."""

    def motion(self, time_s: float) -> Motion | None:
        """The predicted pose and velocity around `time_s`; None if unknown."""

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


class Memoryless:
    """Takes the best detection of every ball and accepts every pose."""

    Config: ClassVar[type[Settings]] = Settings

    def __init__(self, config: Settings, body: model.Body, cameras: Sequence[model.Camera]) -> None:
        self.config = config
        self._pairs = [(ball, camera.name) for camera in cameras for ball in body.names]

    def warm_up(self) -> None:
        """Nothing here is compiled."""

    def expect(self, frame_set: model.FrameSet) -> Mapping[str, Sequence[model.Expectation]]:
        """Search everything."""
        return dict.fromkeys(frame_set.images, ())

    def doubt(self, frame_set: model.FrameSet) -> None:
        """None: every frame set is searched anyway."""

    def judge(
        self, frame_set: model.FrameSet, detections: Mapping[str, Sequence[model.Detection]]
    ) -> tuple[model.BallView, ...]:
        """The first (best) detection of each ball is effective."""
        views = []
        for ball, camera in self._pairs:
            seen = next((d for d in detections.get(camera, ()) if d.ball == ball), None)
            if seen is not None:
                views.append(model.BallView(ball, camera, State.EFFECTIVE, detection=seen))
            else:
                missing = Reason.NOT_FOUND if camera in frame_set.images else Reason.NO_IMAGE
                views.append(model.BallView(ball, camera, State.SUSPENDED, missing))
        return tuple(views)

    def motion(self, time_s: float) -> model.Motion | None:  # noqa: ARG002
        """No motion is known."""
        return None

    def conclude(
        self,
        frame_set: model.FrameSet,  # noqa: ARG002
        views: Sequence[model.BallView],
        positions: Sequence[model.BallPosition],
        pose: model.Pose | None,
        residuals_px: Mapping[tuple[str, str], Floats],  # noqa: ARG002
    ) -> Conclusion:
        """Accept the pose; without one, the reason counts balls and views."""
        if pose is not None:
            return Conclusion(pose)
        effective = sum(view.effective for view in views)
        return Conclusion(None, f"{len(positions)} balls located from {effective} views")

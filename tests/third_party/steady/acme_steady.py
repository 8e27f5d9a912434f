"""A tracker of bodies that stand still: it believes no pose that moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from measure.host import Conclusion, Settings, Tracker, hookimpl, setting
from measure.model import BallView, Detection, Expectation, FrameSet, Motion, Pose
from measure.model.observations import Reason, State


class SteadySettings(Settings):
    """Settings of the `steady` tracker."""

    moved_mm: float = setting(1.0, "A pose farther from the first is refused.", unit="mm", gt=0)


class SteadyTracker(Tracker):
    """Searches whole images, and refuses poses away from the first."""

    name = "steady"
    Config = SteadySettings
    config: SteadySettings
    _first: Pose | None = None

    def expect(self, frame_set: FrameSet) -> Mapping[str, Sequence[Expectation]]:
        return dict.fromkeys(frame_set.images, ())

    def judge(
        self, frame_set: FrameSet, detections: Mapping[str, Sequence[Detection]]
    ) -> tuple[BallView, ...]:
        views = []
        for camera in self.cameras:
            best = {d.ball: d for d in reversed(detections.get(camera.name, ()))}
            for ball in self.body.names:
                if ball in best:
                    view = BallView(ball, camera.name, State.EFFECTIVE, detection=best[ball])
                else:
                    view = BallView(ball, camera.name, State.SUSPENDED, Reason.NOT_FOUND)
                views.append(view)
        return tuple(views)

    def motion(self, time_s: float) -> Motion | None:
        return None

    def conclude(
        self, frame_set: FrameSet, views, positions, pose: Pose | None, residuals_px
    ) -> Conclusion:
        if pose is None:
            return Conclusion(None, f"{len(positions)} balls located")
        self._first = self._first or pose
        off = self._first.world_from_body.difference(pose.world_from_body)[:3]
        if np.linalg.norm(off) > self.config.moved_mm:
            return Conclusion(None, f"{np.linalg.norm(off):.1f} mm from the first pose")
        return Conclusion(pose)


@hookimpl
def measure_trackers() -> list[type[Tracker]]:
    """Register `steady`."""
    return [SteadyTracker]

"""The tracker that remembers nothing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from measure import model
from measure.arrays import Floats
from measure.host import Conclusion, Settings, Tracker
from measure.model import Doubt
from measure.model.observations import Reason, State


class Memoryless(Tracker):
    """Takes the best detection of every ball and accepts every pose."""

    name = "memoryless"

    def __init__(self, config: Settings, body: model.Body, cameras: Sequence[model.Camera]) -> None:
        super().__init__(config, body, cameras)
        self._pairs = [(ball, camera.name) for camera in cameras for ball in body.names]

    def expect(self, frame_set: model.FrameSet) -> Mapping[str, Sequence[model.Expectation]]:
        """Search everything."""
        return dict.fromkeys(frame_set.images, ())

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
        return Conclusion(None, Doubt("few-views", balls=len(positions), views=effective))

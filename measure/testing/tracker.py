"""Conformance tests of trackers."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import ClassVar

import numpy as np

from measure.host import Conclusion, Tracker
from measure.model import BallView, Detection, Expectation, FrameSet, Motion, Pose
from measure.testing.rules import PluginConformance, assert_same
from measure.testing.scenes import example

_STEP_S = 1 / 30


class TrackerConformance(PluginConformance):
    """Tests of a tracker that sees a body at rest, through all calls of the pipeline."""

    plugin: ClassVar[type[Tracker]]  # the class under test
    frame_sets: ClassVar[int] = 20  # how many it is shown

    def build(self) -> Tracker:
        """A fresh instance."""
        scene = example()
        return self.plugin(self.config, scene.body, tuple(scene.cameras.values()))

    def frame_set(self, number: int) -> FrameSet:
        """The images of one instant."""
        time_s = example().time_s + number * _STEP_S
        images = {name: example().image(name) for name in example().cameras}
        moved = {name: replace(image, time_s=time_s) for name, image in images.items()}
        return FrameSet(number, time_s, moved)

    def detections(self, given: FrameSet) -> dict[str, list[Detection]]:
        """Every ball, seen once by every camera, with noise."""
        seen = example().detections(np.random.default_rng(given.index))
        now = [replace(one, time_s=given.time_s) for one in seen]
        return {name: [d for d in now if d.camera == name] for name in given.images}

    def pose(self, time_s: float) -> Pose:
        """What a solver makes of them."""
        body, cameras = example().body, tuple(example().cameras)
        spread = np.diag([0.02] * 3 + [5e-4] * 3) ** 2
        return Pose(time_s, example().world_from_body, spread, 0.05, 0.1, cameras, body.names)

    def step(
        self, tracker: Tracker, number: int, seen: bool = True
    ) -> tuple[tuple[BallView, ...], Conclusion] | None:
        """One frame set through all calls, in the pipeline's order; None: it was skipped."""
        given = self.frame_set(number)
        expected = tracker.expect(given)
        if expected is None:
            return None
        for name, places in expected.items():
            assert name in given.images, f"expectations in {name}, which delivered no image"
            assert all(isinstance(one, Expectation) for one in places), f"in {name}: {places}"
        views = tracker.judge(given, self.detections(given) if seen else {})
        motion = tracker.motion(given.time_s)
        assert motion is None or isinstance(motion, Motion), f"not a Motion: {motion!r}"
        balls = {view.ball for view in views if view.effective}
        positions = example().positions(np.random.default_rng(number)) if seen else []
        residuals = {(view.ball, view.camera): np.zeros(2) for view in views if view.effective}
        located = [replace(one, time_s=given.time_s) for one in positions if one.ball in balls]
        pose = self.pose(given.time_s) if len(located) == len(example().body.balls) else None
        concluded = tracker.conclude(given, views, located, pose, residuals if pose else {})
        assert isinstance(concluded, Conclusion), f"not a Conclusion: {concluded!r}"
        tracker.doubt(given)
        return views, concluded

    def test_a_body_at_rest_is_followed(self) -> None:
        """Every ball is effective in every camera, and the pose accepted without a flag."""
        tracker = self.build()
        last = [self.step(tracker, number) for number in range(self.frame_sets)][-1]
        assert last is not None, "a frame set with every ball in view is skipped"
        views, concluded = last
        assert all(view.effective for view in views), "a ball in full view is suspended"
        assert concluded.pose is not None, f"no pose: {concluded.reason}"
        assert not concluded.pose.flags, f"an easy pose is flagged: {concluded.pose.flags}"

    def test_every_ball_in_every_camera_has_one_state(self) -> None:
        """With a reason where it is suspended."""
        found = self.step(self.build(), 0)
        assert found is not None, "the first frame set is skipped"
        pairs = [(view.ball, view.camera) for view in found[0]]
        wanted = {(b, c) for b in example().body.names for c in example().cameras}
        assert len(pairs) == len(set(pairs)), "a ball has two states in one camera"
        assert set(pairs) == wanted, f"no state of {sorted(wanted - set(pairs))}"

    def test_nothing_seen_is_a_reason(self) -> None:
        """Without a detection there is no pose, and a sentence says why."""
        found = self.step(self.build(), 0, seen=False)
        assert found is not None, "the first frame set is skipped"
        assert not any(view.effective for view in found[0]), "a ball that nobody saw is effective"
        assert found[1].pose is None, "a pose from nothing"
        assert found[1].reason, "no reason is given"

    def test_the_body_is_found_again(self) -> None:
        """After it was out of sight."""
        tracker = self.build()
        for number in range(self.frame_sets):
            self.step(tracker, number, seen=not 5 <= number < 10)
        later = range(self.frame_sets, 2 * self.frame_sets)
        found = [self.step(tracker, number) for number in later]
        assert found[-1] is not None, "it is still skipped"
        assert found[-1][1].pose is not None, "it stays lost"

    def test_it_changes_nothing_that_it_is_given(self) -> None:
        """Detections are others', too."""
        tracker, given = self.build(), self.frame_set(0)
        seen = self.detections(given)
        before = deepcopy(seen)
        tracker.expect(given)
        tracker.judge(given, seen)
        assert_same(seen, before, "input")

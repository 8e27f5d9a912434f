"""Conformance tests of pose solvers."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import ClassVar

import numpy as np

from measure.geometry import squared_mahalanobis
from measure.host import PoseSolver
from measure.model import BallPosition, Body, Detection, Motion, Pose
from measure.testing.rules import PluginConformance, assert_covariance, assert_same
from measure.testing.scenes import example


class PoseSolverConformance(PluginConformance):
    """Tests of a pose solver, on positions and detections of a known scene."""

    plugin: ClassVar[type[PoseSolver]]  # the class under test
    # how far the position may be off, with 0.05 px and 0.05 mm of noise.
    max_error_mm: ClassVar[float] = 0.3
    max_error_deg: ClassVar[float] = 0.5  # how far the rotation may be off then
    max_ratio: ClassVar[float] = 2.0  # how many times the variance the mean squared error may be

    def build(self, body: Body | None = None) -> PoseSolver:
        """A fresh instance."""
        return self.plugin(self.config, body or example().body)

    def seen(self, seed: int = 0) -> tuple[list[BallPosition], list[Detection]]:
        """Positions and detections of all balls, with noise."""
        rng = np.random.default_rng(seed)
        return example().positions(rng), example().detections(rng)

    def solve(
        self,
        positions: list[BallPosition],
        detections: list[Detection],
        prior: Motion | None = None,
    ) -> Pose | None:
        """Solve with a fresh instance."""
        scene = example()
        return self.build().solve(positions, detections, scene.cameras, scene.time_s, prior)

    def test_the_pose_is_found_without_a_prior(self) -> None:
        """The first frame of a recording."""
        self.check_pose(self.solve(*self.seen()))

    def test_the_pose_is_found_with_a_prior_that_is_a_little_wrong(self) -> None:
        """Every later frame."""
        off = example().world_from_body.perturb([1.0, -1.0, 0.5, 0.02, 0.01, -0.02])
        prior = Motion(off, example().time_s, np.zeros(6), np.diag([4.0] * 3 + [4e-3] * 3))
        self.check_pose(self.solve(*self.seen(), prior))

    def test_nothing_seen_gives_none(self) -> None:
        """No positions and no detections."""
        assert self.solve([], []) is None, "a pose from nothing"

    def test_one_ball_gives_none(self) -> None:
        """One ball leaves the rotation free."""
        positions, detections = self.seen()
        ball = positions[0].ball
        pose = self.solve(positions[:1], [d for d in detections if d.ball == ball])
        assert pose is None, f"a pose from one ball: {pose}"

    def test_a_body_of_another_shape_is_refused(self) -> None:
        """Balls 15 mm from where the body file says: no pose, a flag, or a large residual."""
        scene = example()
        scales = np.linspace(1.4, 0.6, len(scene.body.balls))
        balls = [
            replace(ball, center_mm=ball.center_mm * scale)
            for ball, scale in zip(scene.body.balls, scales, strict=True)
        ]
        positions, detections = self.seen()
        pose = self.build(Body("wrong", tuple(balls))).solve(
            positions, detections, scene.cameras, scene.time_s, None
        )
        refused = pose is None or pose.flags or pose.residual_mm > 3 or pose.rms_px > 5
        assert refused, f"a wrong body is accepted: {pose}"

    def test_the_covariance_is_honest(self) -> None:
        """Over 40 draws of the noise, the squared errors are about what it says."""
        ratios = []
        for seed in range(40):
            pose = self.solve(*self.seen(seed))
            assert pose is not None, "no pose"
            error = example().world_from_body.difference(pose.world_from_body)
            ratios.append(squared_mahalanobis(error, pose.covariance) / 6)
        ratio = float(np.mean(ratios))
        assert ratio < self.max_ratio, f"errors {ratio:.1f} times larger (squared) than stated"

    def test_it_keeps_no_state_and_changes_nothing(self) -> None:
        """The same input gives the same answer, bit by bit, and is untouched."""
        scene, given = example(), self.seen()
        solver, before = self.build(), deepcopy(given)
        first = solver.solve(*given, scene.cameras, scene.time_s, None)
        solver.solve(*self.seen(5), scene.cameras, scene.time_s, None)
        again = solver.solve(*given, scene.cameras, scene.time_s, None)
        assert_same(again, first, "second answer")
        assert_same(given, before, "input")

    def check_pose(self, pose: Pose | None) -> None:
        """Types, shapes, names, and nearness to the truth."""
        scene = example()
        assert isinstance(pose, Pose), f"not a Pose: {pose!r}"
        assert pose.time_s == scene.time_s, "not the pose of the instant that was asked for"
        assert_covariance(pose.covariance, 6, "pose")
        assert set(pose.cameras) <= set(scene.cameras), f"cameras {pose.cameras}"
        assert set(pose.balls) == set(scene.body.names), f"balls {pose.balls}"
        assert not pose.flags, f"an easy pose is flagged: {pose.flags}"
        turn = pose.world_from_body.rotation
        assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9), "the rotation is none"
        error = pose.world_from_body.difference(scene.world_from_body)
        off_mm, off_deg = np.linalg.norm(error[:3]), np.degrees(np.linalg.norm(error[3:]))
        assert off_mm <= self.max_error_mm, f"{off_mm:.3g} mm off"
        assert off_deg <= self.max_error_deg, f"{off_deg:.3g} deg off"

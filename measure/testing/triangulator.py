"""Conformance tests of triangulators."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import ClassVar

import numpy as np

from measure.geometry import squared_mahalanobis
from measure.host import Triangulator
from measure.model import BallPosition, Detection
from measure.testing.rules import PluginConformance, assert_covariance, assert_same
from measure.testing.scenes import example


class TriangulatorConformance(PluginConformance):
    """Tests of a triangulator, on exact and on noisy detections of a known scene."""

    plugin: ClassVar[type[Triangulator]]  # the class under test
    # how far a position may be from the truth when the detections are exact.
    max_error_mm: ClassVar[float] = 0.01
    max_ratio: ClassVar[float] = 2.0  # how many times the variance the mean squared error may be

    def build(self) -> Triangulator:
        """A fresh instance."""
        return self.plugin(self.config)

    def seen(self, sd_px: float = 0.0, seed: int = 0, ball: str = "") -> list[Detection]:
        """Detections of one ball in four cameras; without noise their covariance is 0.1 px."""
        scene, rng = example(), np.random.default_rng(seed)
        chosen = ball or scene.body.names[0]
        found = [d for d in scene.detections(rng, sd_px or 1e-12) if d.ball == chosen]
        return [replace(d, covariance_px=(sd_px or 0.1) ** 2 * np.eye(2)) for d in found]

    def test_exact_detections_give_the_exact_centre(self) -> None:
        """With two, three and four cameras, for every ball."""
        scene = example()
        for ball, center in scene.centers.items():
            for count in (2, 3, 4):
                seen = self.seen(ball=ball)[:count]
                position = self.build().triangulate(seen, scene.cameras)
                self.check_form(position, seen)
                assert position is not None
                off = float(np.linalg.norm(position.center - center))
                assert off <= self.max_error_mm, f"{ball}, {count} cameras: {off:.3g} mm off"

    def test_all_balls_at_once_are_located_as_one_by_one(self) -> None:
        """Cameras in any order, one of them wrong; a ball seen once has no position."""
        scene = example()
        first, second, *_ = scene.body.names
        seen = [d for d in scene.detections(np.random.default_rng(5), 0.3) if d.ball != second]
        wrong = next(d for d in seen if d.ball == first)
        seen = [replace(d, center_px=d.center_px + 40) if d is wrong else d for d in seen[::-1]]
        once = next(d for d in scene.detections(np.random.default_rng(5), 0.3) if d.ball == second)
        positions = self.build().triangulate_all([once, *seen], scene.cameras)
        balls = list(dict.fromkeys(d.ball for d in seen))
        alone = [[d for d in seen if d.ball == ball] for ball in balls]
        expected = [self.build().triangulate(some, scene.cameras) for some in alone]
        assert_same(positions, expected, "positions of all balls at once")

    def test_too_little_gives_none(self) -> None:
        """No camera, one camera: there is no depth."""
        for count in (0, 1):
            position = self.build().triangulate(self.seen()[:count], example().cameras)
            assert position is None, f"a position from {count} detections: {position}"

    def test_rays_without_parallax_give_none(self) -> None:
        """Two cameras in one place see one ray twice."""
        scene, seen = example(), self.seen()
        twin = replace(scene.cameras[seen[0].camera], name="twin")
        position = self.build().triangulate(
            [seen[0], replace(seen[0], camera="twin")], {**scene.cameras, "twin": twin}
        )
        assert position is None, f"a position from two equal rays: {position}"

    def test_the_order_of_the_detections_does_not_matter(self) -> None:
        """They come as the cameras' threads finish."""
        seen, cameras = self.seen(0.3, seed=4), example().cameras
        one = self.build().triangulate(seen, cameras)
        other = self.build().triangulate(seen[::-1], cameras)
        assert one is not None, "no position"
        assert other is not None, "no position in the other order"
        assert np.allclose(one.center, other.center, atol=1e-6), "the order changes the position"

    def test_worse_detections_give_a_worse_position(self) -> None:
        """The covariance follows that of the detections."""
        traces = []
        for sd_px in (0.1, 1.0):
            seen = [replace(d, covariance_px=sd_px**2 * np.eye(2)) for d in self.seen()]
            position = self.build().triangulate(seen, example().cameras)
            assert position is not None, "no position"
            traces.append(np.trace(position.covariance))
        assert traces[1] > 2 * traces[0], f"covariances of {traces} mm^2 for 0.1 and 1 px"

    def test_the_covariance_is_honest(self) -> None:
        """Over 150 draws of 0.3 px noise, the squared errors are about what it says."""
        scene, ratios = example(), []
        for seed in range(150):
            position = self.build().triangulate(self.seen(0.3, seed), scene.cameras)
            assert position is not None, "no position"
            error = position.center - scene.centers[position.ball]
            ratios.append(squared_mahalanobis(error, position.covariance) / 3)
        ratio = float(np.mean(ratios))
        assert ratio < self.max_ratio, f"errors {ratio:.1f} times larger (squared) than stated"

    def test_it_keeps_no_state_and_changes_nothing(self) -> None:
        """The same input gives the same answer, bit by bit, and is untouched."""
        triangulator, cameras, seen = self.build(), example().cameras, self.seen(0.3)
        before = deepcopy(seen)
        first = triangulator.triangulate(seen, cameras)
        triangulator.triangulate(self.seen(2.0, seed=9), cameras)
        assert_same(triangulator.triangulate(seen, cameras), first, "second answer")
        assert_same(seen, before, "detections")

    def check_form(self, position: BallPosition | None, seen: list[Detection]) -> None:
        """Types, shapes and names of a position."""
        assert isinstance(position, BallPosition), f"not a BallPosition: {position!r}"
        assert position.ball == seen[0].ball, f"a position of {position.ball!r}"
        assert position.center.shape == (3,), f"centre of shape {position.center.shape}"
        assert np.all(np.isfinite(position.center)), f"centre {position.center}"
        assert_covariance(position.covariance, 3, position.ball)
        names = {d.camera for d in seen}
        assert set(position.cameras) | set(position.dropped) == names, (
            "cameras neither used nor dropped"
        )
        assert not set(position.cameras) & set(position.dropped), "cameras both used and dropped"
        assert len(position.cameras) >= 2, "a position from one camera"
        assert position.residuals_mm.shape == (len(position.cameras),), (
            "not one residual per camera"
        )
        times = [d.time_s for d in seen]
        assert min(times) <= position.time_s <= max(times), (
            "the time is outside that of the detections"
        )

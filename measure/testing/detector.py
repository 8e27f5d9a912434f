"""Conformance tests of detectors."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from measure.host import Detector, SelfCalibratingDetector
from measure.model import Body, Camera, Detection, Expectation, Image
from measure.testing.rules import PluginConformance, assert_covariance, assert_same
from measure.testing.scenes import CLEAR_VIEW, Example, example


class DetectorConformance(PluginConformance):
    """Tests of a detector, on pictures of a simulated scene."""

    plugin: ClassVar[type[Detector]]  # the class under test
    camera: ClassVar[str] = CLEAR_VIEW  # name of the camera whose pictures are used
    # how far a detection may be from the true centre on an easy picture.
    max_error_px: ClassVar[float] = 4.0

    def scene(self, **options: Any) -> Example:
        """The scene to test on; override it for another body."""
        return example(**options)

    def build(self, body: Body | None = None, camera: Camera | None = None) -> Detector:
        """A fresh instance."""
        scene = self.scene()
        return self.plugin(self.config, body or scene.body, camera or scene.cameras[self.camera])

    def expectations(self, off_px: tuple[float, float] = (2.0, -1.5)) -> list[Expectation]:
        """Where tracking would expect the balls, off by `off_px`."""
        scene = self.scene()
        return [scene.expectation(self.camera, name, off_px) for name in scene.body.names]

    def picture(self, **options: Any) -> Image:
        """A fresh picture of the scene."""
        return self.scene(**options).image(self.camera)

    def test_expected_balls_are_found_once_and_in_place(self) -> None:
        """At most one detection per expected ball; here all are plainly visible."""
        found = self.build().detect(self.picture(), self.expectations())
        self.check_form(found)
        scene = self.scene()
        assert sorted(d.ball for d in found) == sorted(scene.body.names), "not each ball once"
        for detection in found:
            self.check_place(detection)

    def test_balls_are_found_in_the_whole_frame(self) -> None:
        """Several candidates per ball are allowed, best first; one of them must be the ball."""
        found = self.build().detect(self.picture(), [])
        self.check_form(found)
        for name in self.scene().body.names:
            candidates = [d for d in found if d.ball == name]
            assert candidates, f"{name} was not found"
            scores = [d.score for d in candidates]
            assert scores == sorted(scores, reverse=True), f"{name}: not the best score first"
            self.check_place(min(candidates, key=self._error_px))

    def test_expected_and_searched_balls_may_be_mixed(self) -> None:
        """A ball without an expectation is searched for."""
        found = self.build().detect(self.picture(), self.expectations()[:1])
        assert {d.ball for d in found} == set(self.scene().body.names), "a ball is missing"

    def test_a_picture_without_balls_gives_nothing(self) -> None:
        """Neither expected nor searched; a candidate of score 0 says "looked at and refused"."""
        for background in ("black", "grey"):
            image = self.picture(background=background, balls=False)
            for expected in ([], self.expectations()):
                found = self.build().detect(image, expected)
                accepted = [d.ball for d in found if d.score > 0]
                assert not accepted, f"{accepted} found before {background} without any ball"

    def test_flat_pictures_give_nothing(self) -> None:
        """A lens cap, an overexposed frame, and snow: noise without colour."""
        width, height = self.scene().cameras[self.camera].intrinsics.size_wh
        snow = np.random.default_rng(1).integers(0, 256, (height, width, 1), dtype=np.uint8)
        flat = [np.full((height, width, 3), level, np.uint8) for level in (0, 255)]
        for pixels in (*flat, np.repeat(snow, 3, axis=2)):
            image = Image(self.camera, 0, 0.0, lambda pixels=pixels: pixels)  # type: ignore[misc]
            found = self.build().detect(image, self.expectations())
            assert not [d for d in found if d.score > 0], "balls found where there is nothing"

    def test_expectations_outside_the_picture_are_survived(self) -> None:
        """A prediction may be anywhere; nothing may be reported from outside."""
        for shift in ((-5000.0, 0.0), (0.0, 5000.0), (-640.0, -360.0)):
            found = self.build().detect(self.picture(), self.expectations(shift))
            self.check_form(found)

    def test_results_do_not_depend_on_what_was_seen_before(self) -> None:
        """Images of other times in between, then earlier ones again: the same, bit by bit.

        A `stateful` detector is exempt. One that calibrates itself may find something else in an
        image the second time, but not after that.
        """
        if self.plugin.stateful:
            return
        detector, times_s = self.build(), [i / 30 for i in range(8)]
        calibrates = isinstance(detector, SelfCalibratingDetector)
        first = [self._answer(detector, time_s) for time_s in times_s]
        if calibrates:
            first = [self._answer(detector, time_s) for time_s in times_s]
        detector.detect(self.picture(background="grey"), [])
        detector.detect(self.picture(balls=False), self.expectations())
        for time_s, expected in reversed(list(zip(times_s, first, strict=True))):
            assert_same(self._answer(detector, time_s), expected, f"second answer at {time_s} s")
        if not calibrates:
            again = self._answer(self.build(), times_s[-1])
            assert_same(again, first[-1], "answer of a new instance")

    def test_self_calibration_keeps_its_promises(self) -> None:
        """States may be exchanged at any time; a known image does not change the calibration."""
        detector, other = self.build(), self.build()
        if not isinstance(detector, SelfCalibratingDetector):
            return
        assert isinstance(other, SelfCalibratingDetector)
        for i in range(64):
            if detector.needs_burn_in:
                self._answer(detector, i / 30)
        state = detector.calibration_state
        self._answer(detector, 0.0)
        assert detector.calibration_state is state, "a known image changed the calibration"
        for states in ([], [None], [state, other.calibration_state]):
            detector.fuse_calibration(states)
        detector.enter_realtime()
        found = self._answer(detector, 65 / 30)
        assert {d.ball for d in found} == set(self.scene().body.names), "a ball is missing"

    def _answer(self, detector: Detector, time_s: float) -> list[Detection]:
        """Its detections in the picture, as if that were taken at `time_s`."""
        return detector.detect(replace(self.picture(), time_s=time_s), self.expectations())

    def test_warming_up_changes_no_answer(self) -> None:
        """What `warm_up` processes must not count as a picture."""
        warm, fresh = self.build(), self.build()
        warm.warm_up()
        first = fresh.detect(self.picture(), self.expectations())
        assert_same(warm.detect(self.picture(), self.expectations()), first, "once warmed up")

    def test_it_changes_nothing_it_is_given(self) -> None:
        """Other cameras' threads and the viewer use the same pixels."""
        image, expected = self.picture(), self.expectations()
        pixels, before = image.pixels.copy(), deepcopy(expected)
        self.build().detect(image, expected)
        self.build().detect(image, [])
        assert np.array_equal(image.pixels, pixels), "the picture was changed"
        assert_same(expected, before, "expectations")

    def check_place(self, detection: Detection) -> None:
        """The detection lies on its ball, and is about as large."""
        off = self._error_px(detection)
        assert off <= self.max_error_px, f"{detection.ball} is {off:.1f} px off"
        ratio = detection.radius_px / self.scene().true_radius_px(self.camera, detection.ball)
        assert 0.8 < ratio < 1.25, f"{detection.ball}: radius is {ratio:.2f} of the true one"

    def _error_px(self, detection: Detection) -> float:
        true_px = self.scene().true_center_px(self.camera, detection.ball)
        return float(np.linalg.norm(detection.center_px - true_px))

    def check_form(self, found: list[Detection]) -> None:
        """Types, shapes, names and ranges of detections."""
        assert isinstance(found, list), f"detect returned {type(found)}, not a list"
        scene = self.scene()
        for detection in found:
            assert isinstance(detection, Detection), f"not a Detection: {detection!r}"
            assert detection.ball in scene.body.names, f"no ball is called {detection.ball!r}"
            assert detection.camera == self.camera, f"camera {detection.camera!r}"
            assert detection.time_s == scene.time_s, "the time is not the image's"
            _check_numbers(detection)
            if detection.outline_px is not None:
                assert self.plugin.provides_outlines is not False, "provides_outlines is False"


def _check_numbers(detection: Detection) -> None:
    ball = detection.ball
    assert detection.center_px.shape == (2,), f"{ball}: centre of shape {detection.center_px.shape}"
    assert np.all(np.isfinite(detection.center_px)), f"{ball}: centre {detection.center_px}"
    assert 0 < detection.radius_px < np.inf, f"{ball}: radius {detection.radius_px}"
    assert 0 <= detection.score <= 1, f"{ball}: score {detection.score}"
    assert np.isnan(detection.color_match) or 0 <= detection.color_match <= 1, f"{ball}: colour"
    assert_covariance(detection.covariance_px, 2, ball)
    if detection.outline_px is None:
        return
    count = len(detection.outline_px)
    assert detection.outline_px.shape == (count, 2), f"{ball}: outline of a wrong shape"
    assert np.all(np.isfinite(detection.outline_px)), f"{ball}: outline not finite"
    sd = detection.outline_sd_px
    assert sd is not None, f"{ball}: outline points without outline_sd_px"
    assert sd.shape == (count,), f"{ball}: outline_sd_px of shape {sd.shape}"
    assert np.all(sd > 0), f"{ball}: outline_sd_px not positive"

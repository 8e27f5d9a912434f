from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure_plugins.detectors import outline
from measure_plugins.detectors.outline import OutlineConfig, OutlineDetector
from tests.plugins.detectors.drawing import BGR, draw, expect, image_of, to_picture
from tests.scenes import FOUR, LENS, RAVEN

SIZE = (640, 480)


@pytest.fixture(scope="module")
def camera():
    matrix = np.array([[1000.0, 0, 318.0], [0, 1003.0, 242.0], [0, 0, 1]])
    return Camera("cam0", Intrinsics(SIZE, matrix, LENS), RigidTransform.identity())


@pytest.fixture(scope="module")
def detector(camera):
    return OutlineDetector(OutlineConfig(), RAVEN, camera)


def at_angle(angle_deg, azimuth_deg, distance=420.0):
    a, b = np.radians(angle_deg), np.radians(azimuth_deg)
    return distance * np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def picture(camera, center, color="red", **kwargs):
    return to_picture(draw(camera, [center], [20.0], [BGR[color]], **kwargs))


@pytest.mark.parametrize("angle_deg", [0.5, 6.0, 12.0])
@pytest.mark.parametrize("background", [(30, 30, 30), (120, 110, 100)])
def test_center_is_unbiased_off_axis(camera, detector, angle_deg, background):
    errors = []
    for azimuth in (20.0, 155.0):
        center = at_angle(angle_deg, azimuth)
        pixels = picture(camera, center, background=background)
        (found,) = detector.detect(
            image_of(camera, pixels),
            [expect(camera, "red", center, 20.0, shift=(1, -1, 0.5)), *hidden_elsewhere(camera)],
        )
        true = camera.intrinsics.project(center[None])[0]
        errors.append(found.center_px - true)
        assert len(found.outline_px) > 60
    assert np.max(np.abs(errors)) < 0.03


def hidden_elsewhere(camera):
    """Expectations for the other balls where there are none."""
    return [
        expect(camera, "green", np.array([-90.0, -60, 420]), 20.0),
        expect(camera, "yellow", np.array([90.0, -60, 420]), 20.0),
    ]


@pytest.mark.parametrize("off_mm", [0.2, 0.8, 2.5, 4.0])
def test_the_outline_is_the_same_wherever_it_was_predicted(camera, detector, off_mm):
    """Near, at the edge of a narrow look and beyond it: 0.5 to 10 px off."""
    center = at_angle(6.0, 40.0)
    pixels = picture(camera, center, background=(30, 30, 30))
    true = camera.intrinsics.project(center[None])[0]
    for shift in ((off_mm, 0, 0), (0, -off_mm, 0.5)):
        expected = expect(camera, "red", center, 20.0, shift=shift, reach_px=14.0)
        (found,) = detector.detect(image_of(camera, pixels), [expected, *hidden_elsewhere(camera)])
        assert np.max(np.abs(found.center_px - true)) < 0.03


def test_covariance_holds_the_scatter(camera, detector):
    """It also holds errors that go together round the outline, which noise alone does not show."""
    rng = np.random.default_rng(4)
    center = at_angle(5.0, 40.0)
    light = draw(camera, [center], [20.0], [BGR["green"]])
    expected = [expect(camera, "green", center, 20.0, shift=(0.5, 0.5, 0))]
    expected += [e for e in hidden_elsewhere(camera) if e.ball == "yellow"]
    expected += [expect(camera, "red", np.array([-90.0, -60, 420]), 20.0)]
    true = camera.intrinsics.project(center[None])[0]
    errors, covariances = [], []
    for _ in range(40):
        pixels = to_picture(light, noise=4.0, rng=rng)
        (found,) = detector.detect(image_of(camera, pixels), expected)
        errors.append(found.center_px - true)
        covariances.append(found.covariance_px)
    scatter = np.sqrt(np.mean(np.var(errors, axis=0)))
    reported = np.sqrt(np.trace(np.mean(covariances, axis=0)) / 2)
    assert 1.0 < reported / scatter < 4.0
    assert scatter < 0.03


def test_unknown_occluder_does_not_move_the_center(camera, detector):
    center = at_angle(4.0, 70.0)
    light = draw(camera, [center], [20.0], [BGR["yellow"]])
    x, y = camera.intrinsics.project(center[None])[0].astype(int)
    pixels = to_picture(light)
    cv2.line(pixels, (x - 60, y - 30), (x + 60, y + 25), (25, 25, 25), 22)
    expected = [expect(camera, "yellow", center, 20.0, shift=(1, 1, 0))]
    expected += [e for e in hidden_elsewhere(camera) if e.ball == "green"]
    expected += [expect(camera, "red", np.array([90.0, -60, 420]), 20.0)]
    (found,) = detector.detect(image_of(camera, pixels), expected)
    assert np.linalg.norm(found.center_px - [*camera.intrinsics.project(center[None])[0]]) < 0.06


def test_nearer_ball_hides_rays(camera, detector):
    near, far = np.array([5.0, 0, 380.0]), np.array([25.0, 8.0, 440.0])
    pixels = to_picture(draw(camera, [near, far], [20.0, 20.0], [BGR["red"], BGR["green"]]))
    expected = [
        expect(camera, "red", near, 20.0, shift=(0.5, 0, 0)),
        expect(camera, "green", far, 20.0, shift=(0.5, 0, 0)),
        expect(camera, "yellow", np.array([-90.0, -60, 420]), 20.0),
    ]
    found = {d.ball: d for d in detector.detect(image_of(camera, pixels), expected)}
    assert set(found) == {"red", "green"}
    for name, center in (("red", near), ("green", far)):
        true = camera.intrinsics.project(center[None])[0]
        assert np.linalg.norm(found[name].center_px - true) < 0.06
    assert len(found["green"].outline_px) < 60 < len(found["red"].outline_px)


def everything_expected(camera, name, center):
    others = [n for n in RAVEN.names if n != name]
    return [expect(camera, name, center, 20.0)] + [
        expect(camera, other, np.array([x, -60.0, 420]), 20.0)
        for other, x in zip(others, (-90.0, 90.0), strict=True)
    ]


def test_wrong_color_is_rejected(camera, detector):
    center = at_angle(3.0, 10.0)
    expected = everything_expected(camera, "red", center)
    assert detector.detect(image_of(camera, picture(camera, center, "green")), expected) == []
    found = detector.detect(image_of(camera, picture(camera, center, "red")), expected)
    assert [d.ball for d in found] == ["red"]
    assert found[0].color_match > 0.9


@pytest.mark.parametrize("turn_deg", [0.0, 30.0])
def test_square_is_rejected(camera, detector, turn_deg):
    center = at_angle(3.0, 10.0)
    middle = camera.intrinsics.project(center[None])[0]
    pixels = np.full((SIZE[1], SIZE[0], 3), 30, np.uint8)
    box = cv2.boxPoints(((float(middle[0]), float(middle[1])), (92.0, 92.0), turn_deg))
    cv2.fillPoly(pixels, [np.rint(box).astype(np.int32)], BGR["red"])
    pixels = cv2.GaussianBlur(pixels, (0, 0), 0.8)
    assert (
        detector.detect(image_of(camera, pixels), everything_expected(camera, "red", center)) == []
    )


def test_whole_frame_is_searched_without_expectations(camera, detector):
    center = at_angle(3.0, 200.0)
    found = detector.detect(image_of(camera, picture(camera, center)), [])
    assert {d.ball for d in found} == {"red"}
    true = camera.intrinsics.project(center[None])[0]
    assert np.linalg.norm(found[0].center_px - true) < 0.05


def test_a_small_ball_far_off_the_axis_of_a_wide_camera_is_kept():
    """There a circle of some pixels is a narrower cone than in the middle, by a third."""
    matrix = np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]])
    wide = Camera("cam0", Intrinsics(SIZE, matrix), RigidTransform.identity())
    center = at_angle(36.0, 8.0)
    found = OutlineDetector(OutlineConfig(), RAVEN, wide).detect(
        image_of(wide, picture(wide, center, background=(110, 100, 105))), []
    )
    (ball,) = (d for d in found if d.ball == "red")
    assert np.linalg.norm(ball.center_px - wide.intrinsics.project(center[None])[0]) < 0.3


def test_warming_up_leaves_no_trace(camera):
    """The disc it draws is white, as a ball may be."""
    white = FOUR.balls[0]
    warm, fresh = (OutlineDetector(OutlineConfig(), FOUR, camera) for _ in range(2))
    warm.warm_up()
    for azimuth in (0.0, 5.0, 10.0):
        center = at_angle(3.0, azimuth)
        pixels = to_picture(draw(camera, [center], [white.radius_mm], [(210, 215, 205)]))
        expected = [expect(camera, white.name, center, white.radius_mm, shift=(1, -1, 0.5))]
        one, other = (d.detect(image_of(camera, pixels), expected) for d in (warm, fresh))
        assert len(one) == len(other) >= 1
        assert np.array_equal(one[0].outline_px, other[0].outline_px)


@pytest.mark.parametrize("sized", [True, False])
def test_balls_measured_together_are_what_each_is_alone(camera, sized):
    """Of any size and in any order; a ball that is not there is left out, not its neighbour."""
    places = [(-90.0, -40.0, 380.0), (5.0, 30.0, 440.0), (95.0, -20.0, 520.0)]
    centers, names = [np.array(place) for place in places], ["red", "green", "yellow"]
    shown = [BGR[name] for name in names]
    pixels = to_picture(draw(camera, centers[::2], [20.0] * 2, shown[::2]))
    expected = [
        expect(camera, name, center, 20.0, shift=(1, -1, 0.5))
        for name, center in zip(names, centers, strict=True)
    ]
    if not sized:
        expected = [replace(one, center_camera=None) for one in expected]
    image, detector = (
        image_of(camera, pixels),
        OutlineDetector(OutlineConfig(self_calibrate=False), RAVEN, camera),
    )
    together = detector.detect(image, expected[::-1])
    alone = [detector._measure(image, [one]) for one in expected]
    assert [len(found) for found in alone] == [1, 0, 1]
    for one, (other,) in zip(together, (alone[2], alone[0]), strict=True):
        assert one.ball == other.ball
        for part in ("center_px", "covariance_px", "outline_px", "outline_sd_px"):
            assert np.array_equal(getattr(one, part), getattr(other, part)), part
        assert (one.radius_px, one.score) == (other.radius_px, other.score)
        assert one.color_match == other.color_match > 0.9


@pytest.mark.parametrize("ground", [30, 120, 200])
def test_grey_ground_alone_is_no_white_ball(camera, ground):
    """Whatever its brightness, and where it grows brighter across the picture."""
    detector = OutlineDetector(OutlineConfig(), FOUR, camera)
    even = np.full((SIZE[1], SIZE[0], 3), float(ground))
    slope = even * np.linspace(0.6, 1.25, SIZE[0])[None, :, None]
    for pixels in (even, slope):
        noisy = pixels + np.random.default_rng(2).normal(scale=3.0, size=pixels.shape)
        image = image_of(camera, np.clip(noisy, 0, 255).astype(np.uint8))
        assert detector.detect(image, []) == []


@pytest.mark.parametrize("seed", range(4))
def test_candidates_given_up_early_would_not_become_balls(camera, monkeypatch, seed):
    """Whole and half hidden balls among patches of their colours, searched with and without."""
    rng = np.random.default_rng(seed)
    colors = ["red", "green", "yellow"]
    centers = [np.array([x, rng.uniform(-50, 50), 420.0]) for x in (-90.0, 5.0, 85.0)]
    pixels = to_picture(draw(camera, centers, [20.0] * 3, [BGR[c] for c in colors]))
    for color in colors:
        corner = rng.integers([20, 20], [560, 420])
        size = rng.integers(12, 60, 2)
        cv2.rectangle(pixels, corner.tolist(), (corner + size).tolist(), BGR[color], -1)
    middle = camera.intrinsics.project(centers[0][None])[0]
    cv2.line(pixels, (0, int(middle[1]) + 8), (SIZE[0], int(middle[1]) + 8), (5, 5, 5), 14)
    pixels = cv2.GaussianBlur(pixels, (0, 0), 0.8)
    found = []
    for give_up_share in (2 / 3, 0.0):
        monkeypatch.setattr(outline, "GIVE_UP_SHARE", give_up_share)
        seen = OutlineDetector(OutlineConfig(), RAVEN, camera).detect(image_of(camera, pixels), ())
        found.append(sorted((d.ball, *d.center_px.tolist(), d.score) for d in seen))
    assert found[0] == found[1]
    assert {one[0] for one in found[0]} == set(colors)

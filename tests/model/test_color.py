"""Ball colours: named, given as ranges, or learnt from samples."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from measure.model import BallColor, ColorRange
from measure.model.body import NAMED_RANGES

PURE = {
    "red": (0, 0, 255), "orange": (0, 128, 255), "yellow": (0, 255, 255), "green": (0, 255, 0),
    "cyan": (255, 255, 0), "blue": (255, 0, 0), "magenta": (255, 0, 255), "white": (255,) * 3,
    "black": (0, 0, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", PURE)
def test_a_named_colour_matches_itself(name):
    assert BallColor.named(name).matches([PURE[name]]).all()


@pytest.mark.parametrize("name", ["red", "yellow", "green", "blue"])
def test_the_common_balls_do_not_match_one_another(name):
    others = [PURE[other] for other in ("red", "yellow", "green", "blue") if other != name]
    assert not BallColor.named(name).matches(others).any()


@pytest.mark.parametrize("hue", [3, 7, 14])
def test_orange_foam_under_a_warm_white_balance_is_orange(hue):
    lit = cv2.cvtColor(np.uint8([[[hue, 190, 220]]]), cv2.COLOR_HSV2BGR)[0]
    assert BallColor.named("orange").matches(lit).all()
    assert not BallColor.named("yellow").matches(lit).any()


def test_names_are_not_case_sensitive_and_unknown_ones_are_refused():
    assert BallColor.named("Green") == BallColor("Green", NAMED_RANGES["green"])
    with pytest.raises(KeyError):
        BallColor.named("mauve-ish")


def _shaded(hue: float, saturation: float, rng: np.random.Generator) -> np.ndarray:
    """BGR samples (200, 3) of a ball of one hue: lit on one side, dark on the other, noisy."""
    hsv = np.column_stack(
        [
            (hue + rng.normal(scale=2, size=200)) % 180,
            np.clip(saturation + rng.normal(scale=12, size=200), 0, 255),
            rng.uniform(60, 250, 200),
        ]
    ).astype(np.uint8)
    bgr = cv2.cvtColor(hsv[:, None, :], cv2.COLOR_HSV2BGR)
    return np.asarray(bgr)[:, 0, :].astype(float)


@given(st.integers(0, 179), st.integers(120, 240))
def test_a_learnt_colour_matches_what_it_was_learnt_from(hue, saturation):
    rng = np.random.default_rng(hue)
    color = BallColor.from_samples(_shaded(hue, saturation, rng))
    assert color.matches(_shaded(hue, saturation, rng)).mean() > 0.9
    assert color.matches(_shaded((hue + 60) % 180, saturation, rng)).mean() < 0.1


def test_red_is_learnt_across_the_end_of_the_hue_circle(rng):
    (learnt,) = BallColor.from_samples(_shaded(179.5, 200, rng)).ranges
    assert learnt.low[0] > learnt.high[0]
    assert learnt.low[0] > 160
    assert learnt.high[0] < 20


@pytest.mark.parametrize("level", [40, 120, 230])
def test_a_ball_without_colour_is_learnt_by_its_brightness(rng, level):
    grey = np.clip(level + rng.normal(scale=4, size=(200, 3)), 0, 255)
    color = BallColor.from_samples(grey)
    assert color.matches(grey).mean() > 0.9
    assert not color.matches([PURE["red"], PURE["green"], PURE["blue"]]).any()


def test_no_samples_are_refused():
    with pytest.raises(ValueError, match="no colour samples"):
        BallColor.from_samples(np.zeros((0, 3)))


def test_a_range_across_red_wraps():
    wrapped = ColorRange("hsv", (170, 100, 50), (8, 255, 255))
    hsv = np.array([[[175, 200, 200], [4, 200, 200], [90, 200, 200], [175, 50, 200]]], np.uint8)
    np.testing.assert_array_equal(wrapped.mask(hsv), [[255, 255, 0, 0]])


def test_lab_ranges_work_beside_hsv_ranges():
    lab = cv2.cvtColor(np.array([[[52, 115, 128]]], np.uint8), cv2.COLOR_BGR2LAB)[0, 0]
    low, high = (tuple(int(v) + d for v in lab) for d in (-3, 3))
    color = BallColor("range", (ColorRange("lab", low, high), NAMED_RANGES["blue"][0]))
    matches = color.matches([[52, 115, 128], PURE["blue"], PURE["green"]])
    np.testing.assert_array_equal(matches, [True, True, False])

"""Balls that a lone lamp lights from one side, or from behind."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.api import build_pipeline, load_profile
from measure.host import Registry
from measure.measuring import Status
from measure.model import BallColor, Image
from measure.session import open_session, read_trajectory
from measure_plugins._acquisition import color_table
from tests.plugins.acquisition.test_candidates import BGR, RAVEN, assert_at, search
from tests.simulated.sessions import rendered
from tests.simulated.unusual import unusual_scenes

HUED = ("red", "green", "yellow", "blue", "orange")
DARK = 0.13
"""Picture values on the unlit side, as a share of the lit side's."""


def half_lit(color, lit_share, radius=60.0, ground=16, noise=2.0):
    """A ball of which a crescent, so wide as a share of its diameter, is in the light."""
    v, u = np.mgrid[:720, :1280].astype(float)
    off = (u - 640.3) ** 2 + (v - 360.6) ** 2
    edge = 640.3 + radius * (2 * lit_share - 1)
    gain = np.where(u < edge, 1.0, DARK)[..., None]
    pixels = np.full((720, 1280, 3), float(ground))
    pixels[off < radius**2] = (gain * np.array(BGR[color]))[off < radius**2]
    noisy = cv2.GaussianBlur(pixels, (0, 0), 1.0)
    noisy += np.random.default_rng(4).normal(scale=noise, size=noisy.shape)
    return Image("cam0", 0, 0.0, lambda: np.clip(np.rint(noisy), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("lit_share", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("color", ["red", "green", "yellow"])
def test_the_whole_ball_is_found_not_its_lit_part(color, lit_share):
    found = search(half_lit(color, lit_share))
    assert_at(found[color][0], 640.3, 360.6, 60, 3.0)
    assert all(len(found[name]) == 0 for name in RAVEN.names if name != color)


def test_colour_reaches_into_the_dark_but_not_into_grey():
    colors = tuple(BallColor.named(name) for name in HUED)
    wide, usual = color_table.with_shade(colors), color_table.color_table(colors)
    assert np.all(wide & usual == usual)  # nothing is lost
    grey = np.random.default_rng(0).normal(20, 2.5, (360, 640, 3))
    cloth = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    assert np.count_nonzero(color_table.classify(cloth, wide, wide, 4)[0]) < 0.01 * 90 * 160
    assert wide[1, 1, 1] == 0  # black
    for bit, name in enumerate(HUED):
        b, g, r = (np.array(BGR[name]) * DARK).astype(int) // 4
        assert wide[b, g, r] & 1 << bit
        assert not usual[b, g, r] & 1 << bit


def test_colours_without_a_hue_do_not():
    for name in ("white", "black"):
        colors = (BallColor.named(name),)
        assert np.array_equal(color_table.with_shade(colors), color_table.color_table(colors))


def test_pictures_in_ordinary_light_are_searched_once():
    lit, dark = np.zeros((40, 60), np.uint8), np.zeros((40, 60), np.uint8)
    lit[10:20, 10:20] = dark[10:20, 10:20] = 2
    assert not color_table.much_in_shade(lit, dark, 2)
    dark[20:22, 10:20] = 2
    assert not color_table.much_in_shade(lit, dark, 2)
    dark[20:24, 10:20] = 2
    assert color_table.much_in_shade(lit, dark, 2)
    assert not color_table.much_in_shade(lit, dark, 1)


def test_a_body_by_a_desk_lamp_is_measured_from_the_first_pictures():
    """It was lost: rough outlines were laid along the terminators."""
    scene = unusual_scenes()["desk-lamp"]
    folder = rendered(replace(scene, seed=5), np.arange(2) / 30)
    truth = read_trajectory(folder / "truth.csv")
    with open_session(folder) as session:
        profile = load_profile("precise")
        pipeline = build_pipeline(profile, Registry.discover(), session.body, session.cameras)
        for one in pipeline.measure(session.frame_sets()):
            assert one.status is Status.OK
            delta = one.pose.world_from_body.difference(truth.at([one.pose.time_s])[0])
            assert np.linalg.norm(delta[:3]) < 0.3
            spread = one.pose.covariance[:3, :3]
            assert delta[:3] @ np.linalg.solve(spread, delta[:3]) < 11.34  # the 99 % region

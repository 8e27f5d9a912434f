"""Colour stored finer than at half the resolution of brightness misleads edges behind a mosaic."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.session import open_session, read_trajectory
from measure.simulation.catalogue import WEBCAM, plain_scene, webcam_scene
from measure_plugins.detectors._coarse_color import has_fringes, has_full_color
from tests.simulated.sessions import rendered

TIMES_S = np.arange(6) / 30.0
SCENE = webcam_scene(12)
PNG = replace(SCENE, sensor=replace(WEBCAM, encoding="png"))


@cache
def position_rms_mm(folder):
    truth = read_trajectory(folder / "truth.csv")
    profile, registry = load_profile("precise"), Registry.discover()
    with open_session(folder) as session:
        poses = [one.pose for _, one in measure_session(session, profile, registry)]
    off = [
        truth.at(np.array([pose.time_s]))[0].translation - pose.world_from_body.translation
        for pose in poses
    ]
    return np.sqrt(np.mean(np.sum(np.square(off), axis=1)))


def test_a_mosaic_stored_whole_is_measured_as_well_as_one_stored_coarsely():
    whole, coarse = (position_rms_mm(rendered(one, TIMES_S)) for one in (PNG, SCENE))
    assert whole < max(1.2 * coarse, 0.02)


JPEG = cv2.IMWRITE_JPEG_SAMPLING_FACTOR


@pytest.mark.parametrize(
    ("ending", "flags", "full"),
    [
        ("jpg", [JPEG, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420], False),
        ("jpg", [JPEG, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422], True),
        ("jpg", [JPEG, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444], True),
        ("png", [], True),
    ],
)
def test_a_file_says_how_it_keeps_colour(ending, flags, full):
    _, data = cv2.imencode(f".{ending}", np.zeros((48, 64, 3), np.uint8), flags)
    assert has_full_color(data.tobytes()) == full


def test_pictures_without_a_mosaic_stay_as_they_are():
    """Of small balls whose colours are sharp, colour says as much as brightness does."""
    with open_session(rendered(plain_scene(), TIMES_S[:2])) as session:
        (first, _) = session.frame_sets()
        assert not any(map(has_fringes, first.images.values()))
    with open_session(rendered(PNG, TIMES_S)) as session:
        assert all(map(has_fringes, next(session.frame_sets()).images.values()))

"""Clocks far apart are found by what each camera sees; where the motion cannot tell, none is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.checking.synchronisation import BallTracks, synchronise
from tests.checking.test_clocks import moving, still
from tests.scenes import RAVEN, moved, ring, see

CAMERAS = ring()


def to_and_fro(time_s):
    return moving(0.2 * np.sin(2 * np.pi * time_s))


def tracks(path, offsets_s, times_s=None, seen_by=CAMERAS, sd_px=0.3):
    """What cameras see of a path whose stamps lack `offsets_s`."""
    rng = np.random.default_rng(0)
    out = []
    for name, camera in CAMERAS.items():
        exposed = np.arange(45) / 30 if times_s is None else times_s[name]
        seen = []
        for time_s in exposed:
            own = see({name: seen_by[name]}, RAVEN, path(time_s), sd_px, rng, time_s)
            seen.append([replace(d, time_s=d.time_s - offsets_s[name]) for d in own])
        out.append(BallTracks.of(camera, RAVEN, seen))
    return out


def late(camera, offset_s):
    return dict.fromkeys(CAMERAS, 0.0) | {camera: offset_s}


@pytest.mark.parametrize("offset_s", [-1.5, -0.08, 0.5])
def test_one_late_clock_is_the_only_one_that_is_off(offset_s):
    found = synchronise(tracks(moving, late("cam1", offset_s)), 2.0, 0.02)
    assert found == pytest.approx(late("cam1", offset_s), abs=0.021)


def test_recordings_of_other_rates_that_began_by_hand_are_brought_together():
    begun = {"cam0": 0.0, "cam1": 0.7, "cam2": 0.3, "cam3": 1.1}
    rates = {"cam0": 30, "cam1": 25, "cam2": 12, "cam3": 24}
    times = {name: begun[name] + np.arange(0, 3.0, 1 / rates[name]) for name in CAMERAS}
    clocks = {"cam0": 0.0, "cam1": 12.4, "cam2": -7.7, "cam3": 0.2}
    found = synchronise(tracks(moving, clocks, times), 25.0, 0.04)
    for name, clock in clocks.items():
        assert found[name] - found["cam0"] == pytest.approx(clock, abs=0.041)


@pytest.mark.parametrize("path", [still, to_and_fro])
def test_a_motion_that_does_not_tell_is_not_asked(path):
    """At rest any offset fits; a motion that repeats itself fits several."""
    times = dict.fromkeys(CAMERAS, np.arange(90) / 30)
    assert synchronise(tracks(path, late("cam1", 0.3), times), 2.0, 0.04) == {}


def test_a_camera_that_was_turned_is_not_late():
    pose = CAMERAS["cam2"].world_from_camera
    turned = moved(CAMERAS["cam2"], pose.perturb([0, 0, 0, 0.02, 0.02, 0.0]))
    found = synchronise(
        tracks(moving, late("cam1", 0.0), seen_by=CAMERAS | {"cam2": turned}), 2.0, 0.04
    )
    assert found == pytest.approx(dict.fromkeys(found, 0.0), abs=0.041)

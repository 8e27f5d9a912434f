"""A board that is waved for a minute: the pictures that are kept calibrate as well as all."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.waving import AZIMUTHS_DEG, calibrated, chosen, errors_mm
from measure.calibration import Corners
from tests.studio.waved import corners, rig, waved

NOISE_PX = 0.05
CAMERAS = rig(AZIMUTHS_DEG)
NAMES = [camera.name for camera in CAMERAS]
pytestmark = pytest.mark.slow


def looked_at(times_s):
    """The corners inside each picture, with noise, by camera."""
    rng, out = np.random.default_rng(0), []
    for time_s in times_s:
        views = {}
        for camera in CAMERAS:
            at = corners(camera, waved(time_s))
            ids = np.flatnonzero(camera.intrinsics.contains(at))
            if len(ids) > 10:
                noisy = at[ids] + rng.normal(0, NOISE_PX, (len(ids), 2))
                views[camera.name] = Corners(ids, noisy, 0.4, "")
        out.append(views)
    return out


def error_mm(instants):
    """Of a position in a world that is set afterwards, with the noise of measuring."""
    return errors_mm(calibrated(NAMES, instants), CAMERAS)[-1]


def test_the_pictures_kept_measure_as_well_as_all_within_a_tenth():
    """And a second and a half of waving does not."""
    instants = looked_at(np.arange(0.0, 60.0))
    kept, after = chosen(CAMERAS, instants, 1.0, 0.2)
    assert len(kept) <= after < 40
    every = error_mm(instants)
    assert error_mm(kept) < 1.1 * every
    assert error_mm(looked_at(np.arange(0.0, 1.5, 0.25))) > 1.5 * every

"""A board that is waved for a minute: the pictures that are kept calibrate as well as all."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.waving import AZIMUTHS_DEG, calibrated, chosen, errors_mm
from tests.studio.waved import looked_at, rig

CAMERAS = rig(AZIMUTHS_DEG)
NAMES = [camera.name for camera in CAMERAS]
pytestmark = pytest.mark.slow


def seen(times_s):
    """The corners in the pictures at each time."""
    rng = np.random.default_rng(0)
    return [looked_at(CAMERAS, time_s, rng) for time_s in times_s]


def error_mm(instants):
    """Of a position in a world that is set afterwards, with the noise of measuring."""
    return errors_mm(calibrated(NAMES, instants), CAMERAS)[-1]


def test_the_pictures_kept_measure_as_well_as_all_within_a_tenth():
    """And a second and a half of waving does not."""
    instants = seen(np.arange(0.0, 60.0))
    kept, after = chosen(CAMERAS, instants, 1.0, 0.2)
    assert len(kept) <= after < 40
    every = error_mm(instants)
    assert error_mm(kept) < 1.1 * every
    assert error_mm(seen(np.arange(0.0, 1.5, 0.25))) > 1.5 * every

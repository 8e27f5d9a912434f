"""The first frame sets of recordings by cameras far from the standard."""

from __future__ import annotations

from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.altered import altered_copy
from measure.api import load_profile, measure_session
from measure.host import Registry
from measure.measuring import Status
from measure.session import open_session, read_trajectory
from measure_plugins._outline.self_calibration import BENDS_SD, has_common_response
from measure_plugins.detectors.outline import OutlineDetector
from tests.simulated.sessions import part_of

pytestmark = pytest.mark.slow


def first_errors(folder, count):
    """Status and error (mm, deg) of the first frame sets; infinite without a pose."""
    out = []
    with open_session(folder) as session:
        truth = read_trajectory(session.truth_path)
        measured = measure_session(session, load_profile("precise"), Registry.discover())
        for _, one in islice(measured, count):
            error = np.full(2, np.inf)
            if one.pose is not None:
                off = one.pose.world_from_body.difference(truth.at([one.pose.time_s])[0])
                error = np.array([np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))])
            out.append((one.status, *error))
    return out


@pytest.fixture
def without_burn_in(monkeypatch):
    """Call it, and recordings are measured from the first frame set to the last, once."""
    return lambda: monkeypatch.setattr(OutlineDetector, "stateful", True)


def test_no_frame_set_of_a_sharpened_recording_is_lost(renders, tmp_path, without_burn_in):
    folder = tmp_path / "sharpened"
    altered_copy(part_of(renders / "still", range(5), tmp_path / "part"), folder, "sharpened")
    for _, position_mm, rotation_deg in first_errors(folder, 3):
        assert position_mm < 0.15
        assert rotation_deg < 0.25
    without_burn_in()
    status, position_mm, _ = first_errors(folder, 1)[0]
    assert status is not Status.OK or position_mm > 0.15


def test_poses_through_a_mild_bend_are_good(still, tmp_path):
    altered_copy(part_of(still, range(6), tmp_path / "part"), tmp_path / "contrast", "contrast")
    assert np.mean([mm for _, mm, _ in first_errors(tmp_path / "contrast", 3)]) < 0.1


@pytest.mark.parametrize(
    ("ratio", "bends", "is_bent"),
    [
        (0.8, [(-1.2, 0.2, 0.7)] * 4, True),  # alone, each would be taken for straight
        (0.8, [(-1.2, 0.2, 0.7)], False),
        (0.8, [(-1.2, 0.2, 0.7), (1.2, -0.2, -0.7)], False),
        (0.96, [(-0.6, 0.3, 0.4)] * 4, False),  # as of straight curves
    ],
)
def test_a_bend_too_mild_for_one_camera_is_seen_by_all_together(ratio, bends, is_bent):
    seen = [SimpleNamespace(residual_ratio=ratio, bends=np.array(one) * BENDS_SD) for one in bends]
    assert has_common_response(seen) == is_bent

"""A calibration's report says what the calibration is worth, and when not to trust it."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest

from measure.calibration import MarkerField, RigCalibration, fit_rig, judge
from measure.model import paper_body
from measure.viewing.report.calibration_report import calibration_report
from tests.calibration import rigs


def _calibration(mark_sd_px: float) -> RigCalibration:
    rig = rigs.rig(np.random.default_rng(3), mark_sd_px=mark_sd_px)
    fit = fit_rig(rig.start, rig.observations)
    points = rig.observations.markers
    field = MarkerField(tuple(f"m{k}" for k in range(len(points))), points)
    return RigCalibration(
        fit.cameras, "joint", {}, fit, rig.observations, field, cameras_before=rig.start
    )


def _maps(page: str) -> list[dict]:
    specs = re.findall(r'class="spec" data-for="[^"]*">(.*?)</script>', page, re.DOTALL)
    traces = [trace for spec in specs for trace in json.loads(spec)["data"]]
    return [trace for trace in traces if trace["type"] == "heatmap"]


@pytest.fixture(scope="module")
def good() -> RigCalibration:
    return _calibration(0.3)


def test_the_maps_are_those_of_the_verdict(good: RigCalibration):
    verdict = judge(good, paper_body())
    page = calibration_report("bench", good, verdict)
    assert f"{verdict.position_sd_mm.max():.3f} mm at worst" in page
    assert 'class="verdict good"' in page
    grid = verdict.workspace.grid()
    above, aside = _maps(page)
    for m, place in (
        (above, lambda a, u: (a, u, verdict.workspace.center[2])),
        (aside, lambda a, u: (a, verdict.workspace.center[1], u)),
    ):
        x, y = (np.array(_values(m[axis])) for axis in "xy")
        z = np.array(_values(m["z"])).reshape(len(y), len(x))
        for row, column in np.ndindex(z.shape):
            away = np.linalg.norm(grid - place(x[column], y[row]), axis=1)
            assert away.min() < 1e-6
            expected = verdict.position_sd_mm[int(np.argmin(away))]
            assert z[row, column] == pytest.approx(expected, rel=1e-6)


def test_marks_that_miss_too_far_make_it_bad():
    loose = _calibration(4.0)
    page = calibration_report("bench", loose, judge(loose, paper_body()))
    assert 'class="verdict bad"' in page
    assert "Do not trust it: its marks miss by" in page
    for camera in loose.cameras:
        assert f"<td>{camera.name}</td>" in page


def _values(array: object) -> object:
    """Plotly writes long arrays as base64."""
    if isinstance(array, dict):
        flat = np.frombuffer(base64.b64decode(array["bdata"]), dtype=array["dtype"])
        return flat.reshape([int(n) for n in array.get("shape", str(len(flat))).split(",")])
    return array

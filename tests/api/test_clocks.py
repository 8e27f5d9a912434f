"""Clocks and shutters of rendered pictures, from `measure check` to a refined calibration."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.cli.app import main
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure.simulation.catalogue import WEBCAM, WORKSPACE_MM, webcam_scene
from measure.simulation.scene import Sines
from tests.simulated.sessions import rendered

LATE_S = {"cam0": 0.0, "cam1": 0.006, "cam2": -0.004, "cam3": 0.0}
"""How much later than their stamps the cameras expose."""
PHASES_S = {"cam0": 0.0, "cam1": 0.008, "cam2": 0.015, "cam3": 0.024}
ROW_S, ROWS = 60e-6, 360
READOUT_S = ROW_S * ROWS
pytestmark = pytest.mark.slow


def halved(camera: Camera) -> Camera:
    """The same view in a quarter of the pixels; of its shutter nothing is known."""
    lens = camera.intrinsics
    matrix = np.diag([0.5, 0.5, 1.0]) @ lens.matrix
    matrix[:2, 2] -= 0.25  # pixel centres lie at integers
    quarter = Intrinsics((640, ROWS), matrix, lens.distortion)
    return replace(camera, intrinsics=quarter, readout_s=0.0)


@pytest.fixture(scope="module")
def rolling(tmp_path_factory) -> Path:
    """A body in quick motion, before cameras out of step whose rows are exposed one by one."""
    scene = webcam_scene()
    middle = RigidTransform(np.eye(3), WORKSPACE_MM)
    reach = np.array([[30.0, 25.0, 25.0, 0.2, 0.2, 0.2]])
    hertz = np.array([[1.1, 1.3, 1.2, 0.9, 1.0, 1.1]])
    to_and_fro = Sines(middle, reach, hertz, np.array([[0.0, 1.5, 3.2, 1.0, 2.0, 0.5]]))
    scene = replace(
        scene,
        cameras=tuple(halved(camera) for camera in scene.cameras),
        trajectory=to_and_fro,
        sensor=replace(WEBCAM, row_time_s=ROW_S),
        phases_s=PHASES_S,
    )
    folder = tmp_path_factory.mktemp("clocks") / "s"
    shutil.copytree(rendered(scene, np.arange(36) / 30), folder)
    for name, late_s in LATE_S.items():
        stamps = folder / f"{name}.csv"
        head, *rows = stamps.read_text().splitlines()
        pairs = [row.split(",") for row in rows]
        rows = [f"{frame},{float(time_s) - late_s:.9f}" for frame, time_s in pairs]
        stamps.write_text("\n".join([head, *rows]) + "\n")
    return folder


def test_check_tells_each_clock_and_each_shutter(rolling, capsys):
    assert main(["check", str(rolling), "--samples", "6", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert [clock["camera"] for clock in found["clocks"]] == list(LATE_S)
    for clock in found["clocks"]:
        assert abs(clock["offset_s"] - LATE_S[clock["camera"]]) < 3 * clock["offset_sd_s"]
        assert clock["offset_sd_s"] < 0.0015
        assert abs(clock["readout_s"] - READOUT_S) < 3 * clock["readout_sd_s"]
        assert clock["readout_s"] > 3 * clock["readout_sd_s"]
    said = [f["text"] for f in found["findings"] if f["topic"] == "clock"]
    assert any(text.startswith("cam1: the clock is +") for text in said)

"""In a browser: a board is waved until it is enough, and the cameras are calibrated by it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure.session import read_calibration
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium, find_chromium
from tests.studio.desk import FOOT, choose, press, studio
from tests.studio.waved import TARGET, picture, rig, waved

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(find_chromium() is None, reason="no chromium on this machine"),
]
ADVICE = "document.querySelector('[data-advice]')?.innerText"
TIMES_S, PERIOD_S = np.arange(0.0, 45.0, 0.75), 0.4
"""Pictures of one instant are told apart from the next ones on a busy machine, too."""


def jpegs(camera, rng):
    return [cv2.imencode(".jpg", picture(camera, waved(t), rng))[1].tobytes() for t in TIMES_S]


def test_from_a_waved_board_to_cameras_that_are_right(tmp_path, rng):
    """Advice comes till nothing is missing; what is calibrated then is what was rendered."""
    true = rig()
    cameras = {c.name: ServedCamera(jpegs(c, rng), PERIOD_S, stamps=True) for c in true}
    with serving(cameras) as addresses, Chromium(1280, 800) as page:
        words = [f"{name}={address}" for name, address in addresses.items()]
        with studio(tmp_path, *words) as address:
            page.open(address + "calibration")
            choose(page, "Board", TARGET)
            press(page, "draw it")
            page.wait_for(f"!!document.querySelector('a[href$=\"{TARGET}.pdf\"]')", 20)
            page.evaluate("document.querySelector('input[aria-label^=Goal]').select()")
            page.send("Input.insertText", text="2")
            press(page, "wave the board")
            page.wait_for(f"{ADVICE}.includes('cam0: ')", 30)
            page.wait_for(f"/capture-1: .*good enough/.test({FOOT})", 200)
            assert page.evaluate(ADVICE) == "enough"
            press(page, "calibrate$")
            page.wait_for("!!document.querySelector('a[href$=\"calibration.html\"]')", 120)
            judgement = "document.querySelector('[data-judgement]').innerText"
            page.wait_for(f"{judgement}.includes('expected body position error')", 20)
            press(page, "world")
            page.wait_for(f"{FOOT}.includes('the world is the board')", 20)
            assert page.errors == []
    one, other = read_calibration(tmp_path / "calibration.toml").cameras
    for found, there in zip((one, other), true, strict=True):
        assert found.intrinsics.focal_px == pytest.approx(there.intrinsics.focal_px, rel=0.005)
    found = one.world_from_camera.inverse() @ other.world_from_camera
    there = true[0].world_from_camera.inverse() @ true[1].world_from_camera
    assert np.linalg.norm(found.translation - there.translation) < 1.5
    assert np.degrees(np.linalg.norm((found @ there.inverse()).rotvec)) < 0.2
    # The world is the board's frame: seen from the cameras' side, z up from the paper.
    assert one.center[2] > 200
    assert (tmp_path / "capture-1" / "capture.toml").is_file()

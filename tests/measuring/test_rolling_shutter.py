"""Cameras whose rows are exposed one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.session import Calibration, read_calibration, write_calibration
from tests import tracking_rig
from tests.measuring.test_pose_spline import shaken
from tests.scenes import RAVEN, ring, see

READOUT_S = 0.020
CAMERAS = ring()
ROLLING = {name: replace(camera, readout_s=READOUT_S) for name, camera in CAMERAS.items()}


class Rolling(tracking_rig.Oracle):
    """Sees each ball where it is when its row is exposed; only the truth knows that it rolls."""

    def detect(self, image, expected):
        found = super().detect(image, expected)
        rolling = ROLLING[self.camera.name]
        out = []
        for d in found:
            late = image.time_s + float(rolling.row_delay_s(d.center_px[1]))
            rng = np.random.default_rng([image.frame, int(d.camera[-1]), len(out)])
            seen = see({d.camera: self.camera}, RAVEN, shaken(late), 0.03, rng, image.time_s)
            out += [one for one in seen if one.ball == d.ball]
        return out


def rms_mm(monkeypatch, cameras):
    monkeypatch.setattr(tracking_rig, "Oracle", Rolling)
    world = lambda t: [(RAVEN, shaken(t))]
    measured, _, _ = tracking_rig.run(RAVEN, world, cameras, 30, smoothing=True, sd_px=0.03)
    off = [m.pose.world_from_body.difference(shaken(m.pose.time_s)) for m in measured[3:-3]]
    return np.sqrt(np.mean(np.sum(np.stack(off)[:, :3] ** 2, axis=1)))


def test_each_row_counts_at_its_own_time(monkeypatch):
    configured, ignored = rms_mm(monkeypatch, ROLLING), rms_mm(monkeypatch, CAMERAS)
    assert configured < 0.015
    assert ignored > 3 * configured


def test_rows_are_late_by_their_place():
    camera = ROLLING["cam0"]
    height = camera.intrinsics.size_wh[1]
    np.testing.assert_allclose(camera.row_delay_s((height - 1) / 2), 0, atol=1e-15)
    np.testing.assert_allclose(camera.row_delay_s([-0.5, height - 0.5]), [-0.010, 0.010])


def test_the_calibration_file_holds_it(tmp_path):
    path = tmp_path / "c.toml"
    write_calibration(path, Calibration((ROLLING["cam0"], CAMERAS["cam1"])))
    assert [c.readout_s for c in read_calibration(path).cameras] == [READOUT_S, 0.0]
    assert path.read_text().count("readout_s") == 1

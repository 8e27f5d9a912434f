"""Calibrations in another unit than the body, wherever they come in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Body, Camera, paper_body
from measure.session import Calibration, check_unit, open_session, write_calibration
from tests.calibration.rigs import cameras, lens
from tests.session.conftest import Recording


def _scaled(rig: tuple[Camera, ...], scale: float) -> Calibration:
    poses = (RigidTransform(c.world_from_camera.rotation, scale * c.center) for c in rig)
    moved = (replace(c, world_from_camera=p) for c, p in zip(rig, poses, strict=True))
    return Calibration(tuple(moved))


def _body(scale: float) -> Body:
    body = paper_body()
    return body.with_centers(scale * body.centers).with_radii(scale * body.radii, np.zeros((3, 3)))


def _stereo(base_mm: float) -> tuple[Camera, ...]:
    places = (RigidTransform(np.eye(3), np.array([x, 0, 0])) for x in (0.0, base_mm))
    return tuple(Camera(f"cam{i}", lens(i), place) for i, place in enumerate(places))


RIGS = {
    "around a bench": (cameras(), 1.0),
    "around a room": (_scaled(cameras(), 10).cameras, 5.0),
    "around a room, a small body": (_scaled(cameras(), 8).cameras, 1.0),
    "two side by side": (_stereo(60.0), 1.0),
    "of an endoscope": (_stereo(5.0), 0.1),
    "side by side, wide": (_stereo(1500.0), 2.0),
}


@pytest.mark.parametrize("name", RIGS)
def test_metres_are_told_from_millimetres_by_the_body(name: str) -> None:
    rig, size = RIGS[name]
    check_unit(_scaled(rig, 1.0), _body(size), "c.toml")
    with pytest.raises(CalibrationError, match=r"c\.toml: .* look like m.* not mm: .* by 1000 "):
        check_unit(_scaled(rig, 1e-3), _body(size), "c.toml")
    with pytest.raises(CalibrationError, match=r"c\.toml: .* would appear 0\.\d* px wide"):
        check_unit(_scaled(rig, 1e3), _body(size), "c.toml")


def test_a_session_is_refused_until_it_says_metres(recording: Recording) -> None:
    with open_session(recording.path) as session:
        rig = session.cameras
    # Four metres apart: no rule that knows nothing of the body finds this suspicious.
    poses = [RigidTransform(c.world_from_camera.rotation, 10 * c.center) for c in rig]
    wide = [replace(c, world_from_camera=p) for c, p in zip(rig, poses, strict=True)]
    body = recording.path / "body.toml"
    body.write_text(body.read_text().replace("38.0", "600.0").replace("20.0", "300.0"))
    path = recording.path / "calibration.toml"
    write_calibration(path, Calibration(tuple(wide)), "anipose")
    text = path.read_text().replace('unit = "mm"\n', "")
    for number in {t for c in wide for t in c.camera_from_world.translation if t}:
        text = text.replace(repr(float(number)), repr(float(number) / 1000))
    Path(path).write_text(text)
    with pytest.raises(CalibrationError, match='say calibration_unit = "m"'):
        open_session(recording.path)
    recording.replace("session.toml", "[session]", '[session]\ncalibration_unit = "m"')
    with open_session(recording.path) as session:
        assert session.cameras[1].center == pytest.approx(wide[1].center)

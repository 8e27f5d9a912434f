"""Fisheye cameras, 120 degrees wide and looking past the workspace, from rendering to the pose."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle

import numpy as np

from measure.api import load_profile, measure_session
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Camera, Intrinsics
from measure.session import open_session, read_trajectory
from measure.simulation import write_session
from measure.simulation.catalogue import plain_scene, ring
from tests.simulated.mirroring import mirrored

FOCAL = 640 / np.radians(120)
LENS = Intrinsics(
    (640, 360),
    np.array([[FOCAL, 0, 322], [0, 1.002 * FOCAL, 178], [0, 0, 1]]),
    np.array([-0.03, 0.006, -0.002, 0.0003]),
    model="fisheye",
)


def _turned(camera: Camera, deg: float) -> Camera:
    aside = RigidTransform.from_rotvec(np.radians(deg) * np.array([0.0, 1.0, 0.0]))
    return replace(camera, intrinsics=LENS, world_from_camera=camera.world_from_camera @ aside)


def test_a_body_35_degrees_off_the_axes_is_measured(tmp_path) -> None:
    """Taken for a pinhole's, an outline there is off by many pixels, in place and in shape."""
    rig = tuple(map(_turned, ring(4, distance_mm=250.0), cycle((35.0, -35.0))))
    write_session(replace(mirrored(plain_scene()), cameras=rig), np.arange(3) / 30, tmp_path)
    truth = read_trajectory(tmp_path / "truth.csv")
    with open_session(tmp_path) as session:
        assert {camera.intrinsics.model for camera in session.cameras} == {"fisheye"}
        measured = measure_session(session, load_profile("precise"), Registry.discover())
        poses = [one.pose for _, one in measured]
    assert None not in poses
    off = np.array([p.world_from_body.difference(truth.at(p.time_s)) for p in poses])
    position, rotation = (np.sqrt(np.mean(np.sum(off[:, k : k + 3] ** 2, axis=1))) for k in (0, 3))
    assert position < 0.15  # measured: 0.08 mm
    assert np.degrees(rotation) < 0.06  # measured: 0.022 deg

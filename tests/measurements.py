"""Measurements made up for tests: three balls, two cameras, a body that drifts and turns."""

from __future__ import annotations

import numpy as np

from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.model import BallPosition, BallView, Camera, Detection, Intrinsics, Pose, paper_body
from measure.model.observations import Reason, State

BODY = paper_body()


def _camera(name, azimuth):
    back = RigidTransform.from_rotvec([0, 0, azimuth]).rotate([0, -450.0, 0])
    z = -back / np.linalg.norm(back)
    x = np.cross(z, [0, 0, 1.0])
    rotation = np.column_stack([x, np.cross(z, x), z])
    lens = Intrinsics((1280, 720), [[1420, 0, 640], [0, 1420, 360], [0, 0, 1]])
    return Camera(name, lens, RigidTransform(rotation, back))


CAMERAS = [_camera("cam0", 0.0), _camera("cam1", 1.5)]


def measurement(index, lost=False):
    place = RigidTransform.from_rotvec([0, 0, 0.01 * index], [0.1 * index, 0, 0])
    centers = place.apply(BODY.centers)
    views, positions = [], []
    for ball, center in zip(BODY.balls, centers, strict=True):
        for camera in CAMERAS:
            uv = camera.project(center[None])[0]
            seen = Detection(ball.name, camera.name, index / 30, uv, 60.0, np.eye(2) * 0.01)
            views.append(BallView(ball.name, camera.name, State.EFFECTIVE, Reason.NONE, seen))
        names = tuple(camera.name for camera in CAMERAS)
        positions.append(
            BallPosition(ball.name, index / 30, center, np.eye(3) * 1e-4, names, np.zeros(2))
        )
    pose = Pose(index / 30, place, np.eye(6) * 1e-4, 0.01, 0.05, ("cam0", "cam1"), BODY.names)
    return Measurement(
        index,
        index / 30,
        {"cam0": index, "cam1": index},
        tuple(views),
        () if lost else tuple(positions),
        None if lost else pose,
        Status.LOST if lost else Status.OK,
        ("nothing seen",) if lost else (),
    )

"""Calibrations as rows of numbers, runs as lines of JSON, cameras by their marks alone."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import block_diag

from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera, RigFit, RigObservations
from measure.session import Calibration, Format, StatedCamera, StatedRig

HEADING = "#acme rows 1"


def read_rows(path: Path, text: str) -> StatedRig | None:
    """Name, width, height, fx, fy, cx, cy, and the 3x4 matrix camera_from_world in mm."""
    if not text.startswith(HEADING):
        return None
    cameras = []
    for number, line in enumerate(text.splitlines()[1:], start=2):
        name, *cells = line.split()
        try:
            width, height, fx, fy, cx, cy, *pose = map(float, cells)
            placed = np.reshape(pose, (3, 4))
        except ValueError as problem:
            raise CalibrationError(f"{path}:{number}: {problem}") from None
        lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        size = int(width), int(height)
        at = placed[:, :3], placed[:, 3]
        cameras.append(StatedCamera(name, lens, np.zeros(5), size_wh=size, pose=at))
    return StatedRig("acme rows", tuple(cameras))


def write_rows(path: Path, calibration: Calibration) -> None:
    """The same; distortion has no place in it."""
    lines = [HEADING]
    for camera in calibration.cameras:
        matrix, pose = camera.intrinsics.matrix, camera.camera_from_world
        lens = *camera.intrinsics.size_wh, *matrix[[0, 1], [0, 1]], *matrix[:2, 2]
        placed = np.column_stack([pose.rotation, pose.translation]).ravel()
        lines.append(" ".join([camera.name, *(repr(float(x)) for x in (*lens, *placed))]))
    path.write_text("\n".join(lines), encoding="utf-8")


def write_run(runs, path: Path) -> None:
    """A line of JSON for each pose."""
    with path.open("w", encoding="utf-8") as file:
        for run in runs:
            for row in run.poses.select(["time_s", "x_mm", "y_mm", "z_mm"]).to_pylist():
                file.write(json.dumps({"body": run.body.name, **row}) + "\n")


ROWS = Format(
    "rows",
    "rows of numbers of ACME's cameras, and lines of JSON for runs",
    read_calibration=read_rows,
    write_calibration=write_rows,
    write_run=write_run,
)


def fit_by_pnp(
    start: tuple[Camera, ...], observations: RigObservations, mark_sd_px: float | None = None
) -> RigFit:
    """Each camera by itself, from six marks or more; its lens is taken as exact."""
    cameras, sds = [], []
    for camera in start:
        marks = observations.marks.get(camera.name)
        if marks is None or len(marks.ids) < 6:
            raise CalibrationError(f"camera {camera.name}: `pnp` needs six marks")
        world, rays = observations.markers[marks.ids], camera.intrinsics.unproject(marks.pixels)
        _, turn, shift = cv2.solvePnP(world, rays[:, :2] / rays[:, 2:], np.eye(3), None)
        pose = RigidTransform.from_rotvec(turn.ravel(), shift.ravel()).inverse()
        placed = Camera(camera.name, camera.intrinsics, pose)
        predicted, _, by_pose, _ = placed.project_with_jacobians(world)
        off = marks.pixels - predicted
        sds.append(mark_sd_px or float(np.sqrt(np.sum(off**2) / (off.size - 6))))
        P = sds[-1] ** 2 * np.linalg.inv(np.einsum("nki,nkj->ij", by_pose, by_pose))
        cameras.append(placed.with_covariance(P, np.zeros(0, np.int64), sds[-1]))
    covariance = block_diag(*(camera.pose_covariance for camera in cameras))
    return RigFit(tuple(cameras), covariance, max(sds))

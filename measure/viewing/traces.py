"""What is drawn over time: residuals, cameras in use, and the error where the truth is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.geometry import RigidTransform
from measure.measuring import Measurement
from measure.model import Camera
from measure.session import Trajectory
from measure.viewing import entities
from measure.viewing.columns import FrameSetBatch


def send_traces(
    columns: FrameSetBatch, sets: Sequence[Measurement], cameras: Sequence[Camera]
) -> None:
    """RMS residual of each camera, and how many cameras see something that is used."""
    squares, counts = np.zeros((2, len(cameras), len(sets)))
    numbers = {camera.name: number for number, camera in enumerate(cameras)}
    cells = [(numbers[name], at) for at, one in enumerate(sets) for _, name in one.residuals_px]
    if cells:
        off = np.array([value for one in sets for value in one.residuals_px.values()])
        here = tuple(np.array(cells).T)
        np.add.at(squares, here, np.sum(off**2, axis=1))
        np.add.at(counts, here, 1)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(squares / counts)
    for camera, values in zip(cameras, rms, strict=True):
        columns.scalars(entities.residual(camera.name), values)
    working = [len({view.camera for view in one.views if view.effective}) for one in sets]
    columns.scalars(entities.EFFECTIVE_CAMERAS, np.array(working, dtype=np.float64))


def send_errors(columns: FrameSetBatch, sets: Sequence[Measurement], truth: Trajectory) -> None:
    """Position and rotation error; frame sets that the truth does not cover have no row."""
    rows = truth.covers(columns.times_s)
    if not rows.any():
        return
    poses = [one.pose for one, covered in zip(sets, rows, strict=True) if covered]
    here = np.array([pose is not None for pose in poses])
    delta = np.full((len(poses), 6), np.nan)
    if here.any():
        found = [pose.world_from_body for pose in poses if pose is not None]
        measured = RigidTransform(
            np.stack([one.rotation for one in found]), np.stack([one.translation for one in found])
        )
        delta[here] = measured.difference(truth.at(columns.times_s[rows][here]))
    values = np.column_stack([delta[:, :3], np.linalg.norm(delta[:, :3], axis=1)])
    for axis, column in zip(entities.ERROR_AXES, values.T, strict=True):
        columns.scalars(entities.error(axis), column, rows)
    turn = np.degrees(np.linalg.norm(delta[:, 3:], axis=1))
    columns.scalars(entities.ROTATION_ERROR, turn, rows)

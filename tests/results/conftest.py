"""Runs of a body that moves as we say, seen by exact cameras with errors we choose."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.model import BallPosition, BallView, Camera, Detection, Intrinsics, Pose, paper_body
from measure.model.observations import Reason, State
from measure.results import Provenance, Run, RunWriter, read_run

BODY = paper_body()
PERIOD_S = 1 / 30


def look_at(name: str, center: tuple[float, float, float]) -> Camera:
    """A camera at `center` that looks at the world's origin."""
    forward = -np.array(center) / np.linalg.norm(center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix = np.array([[1400.0, 0, 639.5], [0, 1400.0, 359.5], [0, 0, 1]])
    pose = RigidTransform(rotation, np.array(center))
    return Camera(name, Intrinsics((1280, 720), matrix), pose, np.eye(6) * 1e-6, 0.1)


CAMERAS = tuple(
    look_at(f"cam{i}", c)
    for i, c in enumerate([(400.0, 300, 300), (-400.0, 300, 300), (-400.0, -300, 300)])
)


def true_pose(time_s: float) -> RigidTransform:
    """A smooth motion of some tens of mm and degrees."""
    turn = np.array([0.3 * np.sin(time_s), 0.2 * np.cos(2 * time_s), 0.5 * time_s])
    shift = 30 * np.array([np.sin(2 * time_s), np.cos(1.5 * time_s), 0.5 * np.sin(3 * time_s)])
    return RigidTransform.from_rotvec(turn, shift)


def measurement(
    index: int,
    error: Floats | None = None,
    covariance: Floats | None = None,
    pixel_error: Floats | None = None,
    lost: bool = False,
    size: float = 1.0,
) -> Measurement:
    """A frame set whose pose is off by `error` (6,) and whose centres are off by `pixel_error`.

    Outlines are `size` times as large as those of the body's balls.
    """
    time_s = index * PERIOD_S
    exact = true_pose(time_s)
    error = np.zeros(6) if error is None else error
    covariance = np.diag([0.01] * 3 + [1e-6] * 3) if covariance is None else covariance
    pixel_error = np.zeros(2) if pixel_error is None else pixel_error
    frames = {camera.name: index for camera in CAMERAS}
    if lost:
        return Measurement(index, time_s, frames, (), (), None, Status.LOST, ("too few balls",))
    views = []
    for camera in CAMERAS:
        centers = camera.project(exact.apply(BODY.centers)) + pixel_error
        for ball, center in zip(BODY.balls, centers, strict=True):
            outline = camera.outline(exact.apply(ball.center_mm), ball.radius_mm, 12)
            radius = size * float(np.mean(np.linalg.norm(outline - outline.mean(axis=0), axis=1)))
            seen = Detection(ball.name, camera.name, time_s, center, radius, np.eye(2) * 0.01)
            views.append(BallView(ball.name, camera.name, State.EFFECTIVE, Reason.NONE, seen))
    positions = tuple(
        BallPosition(
            ball.name, time_s, center, covariance[:3, :3], ("cam0", "cam1"), np.array([0.1, 0.1])
        )
        for ball, center in zip(BODY.balls, exact.apply(BODY.centers) + error[:3], strict=True)
    )
    names = tuple(camera.name for camera in CAMERAS)
    pose = Pose(time_s, exact.perturb(error), covariance, 0.1, 0.2, names, BODY.names)
    residuals = {(v.ball, v.camera): pixel_error for v in views}
    return Measurement(
        index, time_s, frames, tuple(views), positions, pose, Status.OK, residuals_px=residuals
    )


def made_from(**settings: object) -> Provenance:
    return Provenance(
        session="/s",
        session_digest="d",
        calibration="/c",
        calibration_digest="c",
        body_digest="b",
        profile={"name": "paper", "settings": {"detector": {"rays": 64}}, **settings},
        plugins={"detector": "hough of triball 0.1"},
    )


def write_truth(path: Path, end_s: float, rate_hz: float = 240.0, start_s: float = 0.0) -> Path:
    lines = ["time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"]
    for k in range(int(end_s * rate_hz) + 2):
        pose = true_pose(k / rate_hz)
        numbers = [start_s + k / rate_hz, *pose.translation, *pose.quat_wxyz]
        lines.append(",".join(f"{v:.12f}" for v in numbers))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"


def open_writer(folder: Path, **options: bool) -> RunWriter:
    return RunWriter(folder, made_from(), [BODY], CAMERAS, **options)


def written(folder: Path, measurements: Iterable[Measurement], **options: bool) -> Run:
    """A finished run."""
    with open_writer(folder, **options) as writer:
        for one in measurements:
            writer.append(one)
        writer.finish()
    return read_run(folder)


def go_on(folder: Path, count: int) -> int:
    """Resume and finish with `count` frame sets in all; returns how many were kept."""
    with open_writer(folder, resume=True) as writer:
        for i in range(writer.kept, count):
            writer.append(measurement(i))
        writer.finish()
        return writer.kept


def frames_of(folder: Path) -> list[int]:
    return read_run(folder).poses["index"].to_pylist()


def check_whole(folder: Path, count: int) -> None:
    """Every table and poses.csv hold every frame set once."""
    run = read_run(folder)
    assert run.finished
    assert frames_of(folder) == list(range(count))
    assert np.bincount(run.detections["index"].to_numpy()).tolist() == [9] * count
    assert np.bincount(run.balls["index"].to_numpy()).tolist() == [3] * count
    rows = (folder / "poses.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == list(range(count))
    assert not list(folder.glob("*.arrows"))

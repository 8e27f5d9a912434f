"""A recording is read back and holds what was measured."""

from __future__ import annotations

import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.model import Ball, BallColor, BallView, Body, Camera, Detection, Fix, Intrinsics, Pose
from measure.model.observations import Reason, State
from measure.viewing import entities

rr = pytest.importorskip("rerun")
from rerun.chunk import RrdReader  # noqa: E402

from measure.viewing.recording import RunRecording, recording_to_file  # noqa: E402

BODY = Body(
    "three",
    tuple(
        Ball(name, BallColor.named(name), center, 20.0)
        for name, center in (("green", (38, 0, 0)), ("yellow", (0, 38, 0)), ("red", (-38, 0, 0)))
    ),
)


def _camera(name, azimuth):
    back = RigidTransform.from_rotvec([0, 0, azimuth]).rotate([0, -450.0, 0])
    z = -back / np.linalg.norm(back)
    x = np.cross(z, [0, 0, 1.0])
    rotation = np.column_stack([x, np.cross(z, x), z])
    lens = Intrinsics((1280, 720), [[1420, 0, 640], [0, 1420, 360], [0, 0, 1]])
    return Camera(name, lens, RigidTransform(rotation, back))


CAMERAS = [_camera("cam0", 0.0), _camera("cam1", 1.5)]


def _measurement(index, lost=False):
    place = RigidTransform.from_rotvec([0, 0, 0.01 * index], [0.1 * index, 0, 0])
    centers = place.apply(BODY.centers)
    views, fixes = [], []
    for ball, center in zip(BODY.balls, centers, strict=True):
        for camera in CAMERAS:
            uv = camera.project(center[None])[0]
            seen = Detection(ball.name, camera.name, index / 30, uv, 60.0, np.eye(2) * 0.01)
            views.append(BallView(ball.name, camera.name, State.EFFECTIVE, Reason.NONE, seen))
        names = tuple(camera.name for camera in CAMERAS)
        fixes.append(Fix(ball.name, index / 30, center, np.eye(3) * 1e-4, names, np.zeros(2)))
    pose = Pose(index / 30, place, np.eye(6) * 1e-4, 0.01, 0.05, ("cam0", "cam1"), BODY.names)
    return Measurement(
        index,
        index / 30,
        {"cam0": index, "cam1": index},
        tuple(views),
        () if lost else tuple(fixes),
        None if lost else pose,
        Status.LOST if lost else Status.OK,
        "nothing seen" if lost else "",
    )


def _record(path, count, lost=()):
    with RunRecording(recording_to_file(path, "test", ["cam0", "cam1"]), BODY, CAMERAS, 0) as run:
        for index in range(count):
            truth = RigidTransform.from_rotvec([0, 0, 0.01 * index], [0.1 * index + 0.05, 0, 0])
            run.add(_measurement(index, index in lost), truth=truth)
    store = {}
    for chunk in RrdReader(path).store().stream():
        store.setdefault(str(chunk.entity_path).lstrip("/"), []).append(chunk.to_record_batch())
    return store


def _column(batches, name):
    rows = []
    for batch in batches:
        names = batch.schema.names
        if name in names:
            frames = batch.column(names.index("frame")).to_pylist()
            rows += zip(frames, batch.column(names.index(name)).to_pylist(), strict=True)
    return dict(rows)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return _record(tmp_path_factory.mktemp("rrd") / "run.rrd", 130, lost={7})


def test_every_entity_stands_on_both_timelines(recorded):
    expected = {
        entities.BODY,
        entities.TRAIL,
        entities.UNCERTAINTY,
        entities.POSITION_SD,
        entities.ROTATION_ERROR,
        entities.EFFECTIVE_CAMERAS,
        *(entities.error(axis) for axis in entities.ERROR_AXES),
        *(entities.ball(name) for name in BODY.names),
        *(entities.rays(name) for name in BODY.names),
        *(entities.distance(*pair) for pair in BODY.distances()),
        *(make(c.name) for c in CAMERAS for make in (entities.centers, entities.residual)),
    }
    assert expected <= set(recorded)
    for entity in expected:
        frames = {
            f for b in recorded[entity] if "frame" in b.schema.names for f in b["frame"].to_pylist()
        }
        assert len(frames) >= 129, entity
        assert any("time" in b.schema.names for b in recorded[entity])


def test_error_trace_is_the_error_and_gaps_where_there_is_no_pose(recorded):
    error = _column(recorded[entities.error("x")], "Scalars:scalars")
    assert error[3] == pytest.approx([-0.05])
    assert np.isnan(error[7][0])
    assert _column(recorded[entities.error("3d")], "Scalars:scalars")[100] == pytest.approx([0.05])


def test_a_lost_ball_leaves_no_ellipsoid(recorded):
    centers = _column(recorded[entities.ball("red")], "Ellipsoids3D:centers")
    assert centers[7] == []
    assert centers[8][0] == pytest.approx(_measurement(8).fixes[2].center, abs=1e-3)


def test_size_without_images(tmp_path):
    _record(tmp_path / "run.rrd", 300)
    assert (tmp_path / "run.rrd").stat().st_size < 1_000_000

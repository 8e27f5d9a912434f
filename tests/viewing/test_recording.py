"""A recording is read back and holds what was measured."""

from __future__ import annotations

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.viewing import entities, recording
from measure.viewing.recording import RunRecording, open_recording
from tests.viewing.reading import column, read_recording


def _record(path, count, lost=()):
    with RunRecording(open_recording("test", CAMERAS, path), BODY, CAMERAS, 0) as run:
        for index in range(count):
            truth = RigidTransform.from_rotvec([0, 0, 0.01 * index], [0.1 * index + 0.05, 0, 0])
            run.add(measurement(index, index in lost), truth=truth)
    return read_recording(path)


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
    error = column(recorded[entities.error("x")], "Scalars:scalars")
    assert error[3] == pytest.approx([-0.05])
    assert np.isnan(error[7][0])
    assert column(recorded[entities.error("3d")], "Scalars:scalars")[100] == pytest.approx([0.05])


def test_a_lost_ball_leaves_no_ellipsoid(recorded):
    centers = column(recorded[entities.ball("red")], "Ellipsoids3D:centers")
    assert centers[7] == []
    assert centers[8][0] == pytest.approx(measurement(8).fixes[2].center, abs=1e-3)


def test_size_without_images(tmp_path):
    _record(tmp_path / "run.rrd", 300)
    assert (tmp_path / "run.rrd").stat().st_size < 1_000_000


@pytest.mark.parametrize(
    ("address", "said"),
    [("localhost:9876", "is no viewer's address"), ("rerun+http://127.0.0.1:1/proxy", "no viewer")],
)
def test_a_viewer_that_does_not_listen_is_said_not_silently_skipped(address, said, monkeypatch):
    monkeypatch.setattr(recording, "CONNECT_WITHIN_S", 0.0)
    with pytest.raises(ConfigError, match=said):
        open_recording("test", CAMERAS, address=address)

"""A recording is read back and holds what was measured."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest
import rerun as rr
from measurements import BODY, CAMERAS, measurement

from measure.errors import ConfigError, RunError
from measure.geometry import RigidTransform
from measure.model import FrameSet, Image
from measure.model.observations import BallView, Reason, State
from measure.session import Trajectory
from measure.viewing import entities, recording, state_colors, viewer
from measure.viewing.blueprint import run_blueprint
from measure.viewing.recording import OpenRecording, RunRecording, open_recording
from tests.viewing.reading import column, read_recording


def _record(path, count, lost=()):
    k = np.arange(count)[:, None]
    aside = RigidTransform.from_rotvec(k * [0, 0, 0.01], k * [0.1, 0, 0] + [0.05, 0, 0])
    truth = Trajectory(np.arange(count) / 30, aside)
    stream = open_recording("test", CAMERAS, path)
    with RunRecording(stream, [BODY], CAMERAS, 0, truths={BODY.name: truth}) as run:
        for index in range(count):
            run.add([measurement(index, index in lost)])
    return read_recording(path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return _record(tmp_path_factory.mktemp("rrd") / "run.rrd", 130, lost={7})


@pytest.mark.parametrize("truth", [True, False])
def test_the_first_plot_shows_errors_only_where_there_is_a_truth(truth):
    layout = run_blueprint(CAMERAS, truth=truth).root_container
    first = [view.name for view in layout.contents[1].contents[0].contents]
    assert first == [*(["Error [mm]"] if truth else []), "Position [mm]", "Rotation [deg]"]


def test_marks_stand_where_there_is_a_picture_of_their_instant(tmp_path):
    """Without any pictures they stand in every frame set."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    for every, marked in ((3, [0, 3, 6]), (0, [*range(8)])):
        path = tmp_path / f"{every}.rrd"
        stream = open_recording("test", CAMERAS, path)
        with RunRecording(stream, [BODY], CAMERAS, every) as run:
            for index in range(8):
                images = {c.name: Image(c.name, index, index / 30, lambda: pixels) for c in CAMERAS}
                run.add([measurement(index)], FrameSet(index, index / 30, images))
        stored = read_recording(path)
        for entity in (entities.centers("cam0"), entities.suspended("cam0")):
            assert [*column(stored[entity], "Points2D:positions")] == marked
        assert [*column(stored[entities.position("x")], "Scalars:scalars")] == [*range(8)]


def test_coordinates_have_plots_of_their_own():
    layout = run_blueprint(CAMERAS).root_container
    position = layout.contents[1].contents[0].contents[0]
    assert [view.name for view in position.contents] == ["x", "y", "z"]


def test_a_preview_shows_five_pictures_a_second_of_each_camera(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "check_listening", lambda address: None)
    monkeypatch.setattr(recording.rr, "GrpcSink", lambda _: rr.FileSink(tmp_path / "seen.rrd"))
    preview = recording.LivePictures(["a", "b"], "nowhere", print)
    for frame in range(15):
        for name in ("a", "b"):
            preview.add(Image(name, frame, 1.7e9 + 0.07 * frame, lambda: None, bytes([frame])))
    preview.close()
    for name in ("a", "b"):
        batches = read_recording(tmp_path / "seen.rrd")[entities.image(name)]
        shown = [blob for b in batches for blob in b["EncodedImage:blob"].to_pylist()]
        assert [bytes(one[0]) for one in shown] == [bytes([k]) for k in (0, 3, 6, 9, 12)]


def test_a_viewer_outlives_the_interrupt_of_who_opened_it(tmp_path, monkeypatch):
    program = tmp_path / "viewer"
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_program", lambda: str(program))
    process = viewer.open_viewer([]).process
    try:
        assert os.getpgid(process.pid) != os.getpgrp()
    finally:
        process.kill()
        process.wait()


def test_a_viewer_for_browsers_hears_them_when_it_is_opened(tmp_path, monkeypatch):
    program = tmp_path / "viewer"
    program.write_text(
        f"#!{sys.executable}\nimport socket, sys, time\ntime.sleep(0.7)\n"
        "port = int(sys.argv[sys.argv.index('--web-viewer-port') + 1])\n"
        "with socket.create_server(('127.0.0.1', port)):\n    time.sleep(60)\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_program", lambda: str(program))
    opened = viewer.open_viewer([], web=True)
    try:
        place = urlsplit(opened.address)
        socket.create_connection((place.hostname, place.port), 5.0).close()
    finally:
        opened.process.kill()
        opened.process.wait()


def test_a_viewer_that_ends_before_it_serves_is_named(monkeypatch):
    monkeypatch.setattr(viewer, "viewer_program", lambda: "false")
    with pytest.raises(RunError, match="served nothing, and ended with code 1"):
        viewer.open_viewer([], web=True)


def test_an_interrupt_while_it_is_waited_for_leaves_no_viewer(tmp_path, monkeypatch):
    program, begun = tmp_path / "viewer", []
    program.write_text("#!/bin/sh\nexec sleep 60\n")
    program.chmod(0o755)

    def begin(*given, **how):
        begun.append(subprocess.Popen(*given, **how))
        return begun[0]

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "viewer_program", lambda: str(program))
    monkeypatch.setattr(viewer, "subprocess", SimpleNamespace(Popen=begin))
    monkeypatch.setattr(viewer, "time", SimpleNamespace(monotonic=time.monotonic, sleep=interrupt))
    with pytest.raises(KeyboardInterrupt):
        viewer.open_viewer([], web=True)
    assert begun[0].wait(10) == -signal.SIGKILL


def test_error_trace_is_the_error_with_gaps_without_pose(recorded):
    error = column(recorded[entities.error("x")], "Scalars:scalars")
    assert error[3] == pytest.approx([-0.05])
    assert np.isnan(error[7][0])
    assert column(recorded[entities.error("3d")], "Scalars:scalars")[100] == pytest.approx([0.05])


def test_a_lost_ball_leaves_no_ellipsoid(recorded):
    centers = column(recorded[entities.ball("red")], "Ellipsoids3D:centers")
    assert centers[7] == []
    assert centers[8][0] == pytest.approx(measurement(8).positions[2].center, abs=1e-3)


def test_a_lost_body_leaves_no_axes_no_trail_and_no_uncertainty(recorded):
    """What was logged last stays in view: it must be wiped away."""
    axes = column(recorded[entities.BODY], "TransformAxes3D:axis_length")
    assert [axes[k][0] for k in (6, 7, 8)] == [40.0, 0.0, 40.0]
    for entity, name in (
        (entities.TRAIL, "Points3D:positions"),
        (entities.UNCERTAINTY, "Ellipsoids3D:half_sizes"),
    ):
        shown = column(recorded[entity], name)
        assert [len(shown[k]) for k in (6, 7, 8)] == [1, 0, 1]


def test_the_ellipsoid_is_about_as_large_as_a_ball_and_says_how_enlarged(tmp_path):
    """By one factor while the uncertainty stays, by another one where it grows a hundredfold."""
    path, one = tmp_path / "run.rrd", measurement(0)
    scales = [1.0, 1.0, 2.0, 100.0, 100.0]
    with RunRecording(open_recording("test", CAMERAS, path), [BODY], CAMERAS, 0) as run:
        for index, scale in enumerate(scales):
            pose = replace(one.pose, covariance=scale**2 * one.pose.covariance)
            run.add([replace(one, index=index, time_s=index / 30, pose=pose)])
            run.flush()
    stored = read_recording(path)[entities.UNCERTAINTY]
    labels = [label for (label,) in column(stored, "Ellipsoids3D:labels").values()]
    halves = np.array(list(column(stored, "Ellipsoids3D:half_sizes").values()))[:, 0]
    factors = np.array([float(label.removeprefix("SD x")) for label in labels])
    largest = np.sqrt(np.linalg.eigvalsh(one.pose.covariance[:3, :3])[-1])
    assert halves.max(axis=1) == pytest.approx(factors * scales * largest, rel=1e-5)
    assert factors / factors[0] == pytest.approx([1, 1, 1, 0.01, 0.01])
    assert np.all(np.abs(np.log10(halves.max(axis=1) / BODY.balls[0].radius_mm)) < 1)


def test_unused_ball_is_marked_in_place_with_the_reason(tmp_path):
    one = measurement(5)
    missed = BallView("red", "cam0", State.SUSPENDED, Reason.NOT_FOUND)
    jumped = replace(one.views[1], state=State.SUSPENDED, reason=Reason.JUMPED)
    rest = [v for v in one.views if (v.ball, v.camera) not in (("red", "cam0"), ("green", "cam1"))]
    assert (jumped.ball, jumped.camera) == ("green", "cam1")
    path = tmp_path / "run.rrd"
    with RunRecording(open_recording("test", CAMERAS, path), [BODY], CAMERAS, 0) as run:
        run.add([measurement(4)])
        run.add([replace(one, views=(missed, jumped, *rest))])
        run.add([replace(measurement(6, lost=True), views=(missed,))])
    stored = read_recording(path)
    marks = stored[entities.suspended("cam0")]
    assert list(column(marks, "Points2D:labels").values()) == [[], ["red: not found"], []]
    expected = CAMERAS[0].project(one.pose.world_from_body.apply(BODY.centers))[2]
    assert column(marks, "Points2D:positions")[5][0] == pytest.approx(expected, abs=1e-3)
    (label,) = column(stored[entities.suspended("cam1")], "Points2D:labels")[5]
    assert label == "green: moved too far between frames"
    red, green, blue = state_colors.REASONS[Reason.JUMPED]
    color = column(stored[entities.suspended("cam1")], "Points2D:colors")[5]
    assert color == [red << 24 | green << 16 | blue << 8 | 255]
    centers = column(stored[entities.centers("cam1")], "Points2D:colors")[5]
    assert color[0] in centers
    assert len(set(centers)) == 2


def test_somebody_who_watches_sees_each_frame_set_soon(tmp_path, monkeypatch):
    """Sent at once, not when a batch is full; without a watcher, all in one."""
    sent = []
    monkeypatch.setattr(recording, "LIVE_PERIOD_S", 0.0)
    monkeypatch.setattr(
        recording.scene, "send_views", lambda _, sets, *rest: sent.append(len(sets))
    )
    for live in (True, False):
        log = open_recording("test", CAMERAS, tmp_path / f"{live}.rrd")
        with RunRecording(log, [BODY], CAMERAS, 0, live=live) as run:
            for index in range(3):
                run.add([measurement(index)])
    assert sent == [1, 1, 1, 3]


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("localhost:9876", "is no viewer's address"),
        ("rerun+http://h:99999", "is no viewer's address"),
        ("rerun+http://[h", "is no viewer's address"),
        ("rerun+http://127.0.0.1:1/proxy", "no viewer"),
    ],
)
def test_viewer_that_does_not_listen_is_an_error(address, said, monkeypatch):
    monkeypatch.setattr(recording, "CONNECT_WITHIN_S", 0.0)
    with pytest.raises(ConfigError, match=said):
        open_recording("test", CAMERAS, address=address)


def test_run_without_poses_still_has_a_recording(tmp_path):
    stored = _record(tmp_path / "run.rrd", 20, lost=range(20))
    said = column(stored[entities.STATUS], "TextLog:text")
    assert said == {0: ["lost: nothing seen"]}
    assert np.isnan(list(column(stored[entities.POSITION_SD], "Scalars:scalars").values())).all()
    axes = column(stored[entities.BODY], "TransformAxes3D:axis_length")
    assert set(np.ravel(list(axes.values()))) == {0.0}
    shown = column(stored[entities.ball("red")], "Ellipsoids3D:centers")
    assert len(shown) == 20
    assert not any(shown.values())


@pytest.mark.parametrize(("begins_s", "kind"), [(0.0, "duration"), (1.7e9, "timestamp")])
def test_times_since_1970_are_shown_as_dates(tmp_path, begins_s, kind):
    """Of what is logged by the column, and of what is logged when it happens."""
    path = tmp_path / "run.rrd"
    with RunRecording(open_recording("test", CAMERAS, path), [BODY], CAMERAS, 0) as run:
        for index in range(4):
            one = measurement(index)
            run.add([replace(one, time_s=begins_s + one.time_s)])
    stored = read_recording(path)
    for entity in (entities.BODY, entities.STATUS):
        for batch in stored[entity]:
            if entities.TIMELINE_TIME in batch.schema.names:
                times = batch.column(batch.schema.names.index(entities.TIMELINE_TIME))
                assert str(times.type).startswith(kind)
                assert times.cast("int64")[0].as_py() == pytest.approx(begins_s * 1e9, abs=1e3)


def test_a_writer_that_died_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rerun itself waits for ever, where the writer dies between two questions."""
    asked, over = threading.Event(), threading.Event()

    class Dead:
        def flush(self, timeout_sec: float) -> None:
            assert timeout_sec < 1000
            raise RuntimeError("Flush timed out - not all log messages were sent")

        def disconnect(self) -> None:
            asked.set()
            over.wait(60)

    monkeypatch.setattr(recording.scene, "log_rig", lambda *_: None)
    monkeypatch.setattr(recording.rr, "unregister_shutdown", lambda: None)
    dead = OpenRecording(Dead())  # type: ignore[arg-type]
    log = RunRecording(dead, [BODY], CAMERAS, 0)
    begun_s = time.monotonic()
    with pytest.raises(RuntimeError, match="timed out"):
        log.close()
    assert time.monotonic() - begun_s < 20
    assert asked.wait(20)
    over.set()

"""A rendered session with one camera dark, from `measure run` to the recording and the report."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from benchmarks.sinks import free_port
from measure import api
from measure.host import Registry
from measure.results import read_run
from measure.session import open_session, read_trajectory
from measure.viewing import entities
from measure.viewing.recording import RunRecording, open_recording
from measure.viewing.viewer import viewer_program
from measure_lab import api as lab
from tests.viewing.reading import column, read_recording

SETS = 8
REPEATS = 6
DARK = "cam3"
CAMERAS = ("cam0", "cam1", "cam2", DARK)
BALLS = ("green", "yellow", "red")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("signals")]


@pytest.fixture(scope="module")
def session(renders: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frame sets of a render; the lens cap is on one camera."""
    source = renders / "still"
    folder = tmp_path_factory.mktemp("dark") / "session"
    folder.mkdir()
    for name in ("session.toml", "body.toml", "calibration.toml", "truth.csv"):
        shutil.copy(source / name, folder / name)
    black = cv2.imencode(".jpg", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()
    for name in CAMERAS:
        (folder / name).mkdir()
        lines = (source / f"{name}.csv").read_text().splitlines()
        (folder / f"{name}.csv").write_text("\n".join(lines[: SETS + 1]) + "\n")
        for picture in sorted((source / name).glob("*.jpg"))[:SETS]:
            data = black if name == DARK else picture.read_bytes()
            (folder / name / picture.name).write_bytes(data)
    return folder


@pytest.fixture(scope="module")
def measured(session: Path) -> Path:
    out = session.parent / "run"
    options = api.RunOptions(images="all")
    api.run(session, out, api.load_profile(), Registry.discover(), options)
    return out


def test_every_entity_stands_in_the_recording_on_both_timelines(measured: Path, session: Path):
    stored = read_recording(measured / "run.rrd")
    still = {entities.WORLD, *map(entities.camera, CAMERAS)}
    moving = {
        entities.BODY, entities.TRAIL, entities.UNCERTAINTY, entities.STATUS,
        entities.POSITION_SD, entities.ROTATION_ERROR, entities.EFFECTIVE_CAMERAS,
        *map(entities.error, entities.ERROR_AXES),
        *(make(ball) for ball in BALLS for make in (entities.ball, entities.rays)),
        *(entities.distance(*pair) for pair in read_run(measured).body.distances()),
        *(make(camera) for camera in CAMERAS
          for make in (entities.image, entities.centers, entities.outlines, entities.edges,
                       entities.suspended, entities.residual)),
    }  # fmt: skip
    assert still | moving <= set(stored)
    for entity in moving:
        timelines = {name for batch in stored[entity] for name in batch.schema.names}
        assert {entities.TIMELINE_FRAME, entities.TIMELINE_TIME} <= timelines, entity
    pictures = column(stored[entities.image("cam0")], "EncodedImage:blob")
    first = next((session / "cam0").iterdir()).parent / "000000.jpg"
    assert bytes(np.array(pictures[0][0], np.uint8)) == first.read_bytes()


def test_the_layout_travels_inside(measured: Path):
    reader = RrdReader(measured / "run.rrd")
    (layout,) = reader.blueprints()
    assert layout.application_id == reader.recordings()[0].application_id
    names = {
        str(value)
        for chunk in reader.store(store=layout).stream()
        for batch in [chunk.to_record_batch()]
        for name in batch.schema.names
        if name == "ViewBlueprint:display_name"
        for value in np.ravel(batch[name].to_pylist())
    }
    assert {"Scene", "Error [mm]", "Residual [px]", *CAMERAS} <= names


def test_the_error_traces_are_those_of_the_evaluation(measured: Path, session: Path):
    stored = read_recording(measured / "run.rrd")
    found = api.evaluate(measured, session / "truth.csv")
    for axis in ("x", "y", "z"):
        trace = np.array(list(column(stored[entities.error(axis)], "Scalars:scalars").values()))
        assert np.sqrt(np.mean(trace**2)) == pytest.approx(found.body.rms_mm[axis], rel=1e-9)
    trace = np.array(list(column(stored[entities.error("3d")], "Scalars:scalars").values()))
    assert np.sqrt(np.mean(trace**2)) == pytest.approx(found.body.rms_3d_mm, rel=1e-9)
    truth = read_trajectory(session / "truth.csv")
    turned = [
        np.degrees(
            np.linalg.norm(read_run(measured).world_from_body[k].difference(truth.at(t))[3:])
        )
        for k, t in enumerate(read_run(measured).times_s)
    ]
    trace = list(column(stored[entities.ROTATION_ERROR], "Scalars:scalars").values())
    assert np.ravel(trace) == pytest.approx(turned)


def test_the_report_names_the_dark_camera(measured: Path):
    page = lab.report(measured).read_text("utf-8")
    assert f"3 of 4 cameras carry it ({DARK} never)" in page
    run = read_run(measured)
    rows = [r for r in run.detections.to_pylist() if r["camera"] == DARK]
    assert len(rows) == SETS * len(BALLS)
    assert all(row["state"] == "suspended" and row["reason"] for row in rows)


def test_logging_costs_less_than_a_tenth_of_measuring(session: Path, tmp_path: Path):
    """Without pictures, in processor time of the same process; the best of three.

    In itself it stays below the time that two pictures take to decode: tracking may become faster.
    """
    with open_session(session) as opened:
        began = time.process_time()
        pairs = list(api.measure_session(opened, api.load_profile(), Registry.discover()))
        measuring = time.process_time() - began
        costs = []
        for trial in range(3):
            stream = open_recording("cost", opened.cameras, tmp_path / f"{trial}.rrd")
            with RunRecording(stream, [opened.body], opened.cameras, 0) as log:
                began = time.process_time()
                for frame_set, measurement in pairs * REPEATS:
                    log.add([measurement], frame_set)
            costs.append((time.process_time() - began) / REPEATS)
        jpeg = next((session / "cam0").glob("*.jpg")).read_bytes()
        began = time.process_time()
        for _ in range(10):
            cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        picture = (time.process_time() - began) / 10
    words = f"logging {min(costs):.4f} s, measuring {measuring:.3f} s, a picture {picture:.4f} s"
    print(words)
    assert min(costs) <= 0.1 * measuring, words
    assert min(costs) <= 2 * picture * SETS, words


def test_recording_is_little_larger_than_its_pictures(
    measured: Path, session: Path, tmp_path: Path
):
    """300 frame sets of four cameras must fit in 110 MB where their JPEGs take 100 MB."""
    with open_session(session) as opened:
        stream = open_recording("empty", opened.cameras, tmp_path / "empty.rrd")
        RunRecording(stream, [opened.body], opened.cameras, 0).close()
    once = (tmp_path / "empty.rrd").stat().st_size  # Layout, rig and styles
    pictures = sum(path.stat().st_size for path in session.rglob("*.jpg"))
    beside = (measured / "run.rrd").stat().st_size - pictures - once
    total = once + beside / SETS * 300
    print(f"{1e-6 * total:.1f} MB beside the pictures in 300 frame sets")
    assert total <= 10_000_000


def _wait_until_settled(path: Path, still_s: float = 2.0, at_most_s: float = 60.0) -> None:
    """Until a file has not grown for a while: what was sent may still be on its way."""
    size, since, end = -1, time.monotonic(), time.monotonic() + at_most_s
    while time.monotonic() < min(since + still_s, end):
        if path.exists() and path.stat().st_size != size:
            size, since = path.stat().st_size, time.monotonic()
        time.sleep(0.1)


def test_a_viewer_that_runs_already_is_sent_what_is_measured(session: Path, tmp_path: Path):
    """`--connect`: here to Rerun's own receiver, which writes what it gets into a file."""
    port = free_port()
    heard, said = tmp_path / "heard.rrd", list[str]()
    command = [viewer_program(), "--save", heard, "--bind", "127.0.0.1", "--port", str(port)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as receiver:
        try:
            options = api.RunOptions(
                connect=f"rerun+http://127.0.0.1:{port}/proxy", recording=False, images=6
            )
            given = session, tmp_path / "run", api.load_profile(), Registry.discover()
            api.run(*given, options, on_note=said.append)
            _wait_until_settled(heard)
        finally:
            _stop(receiver)
    stored = read_recording(heard)
    error = column(stored[entities.error("x")], "Scalars:scalars")
    assert sorted(error) == list(range(SETS))
    assert sorted(column(stored[entities.image("cam0")], "EncodedImage:blob")) == [0, 6]
    assert not (tmp_path / "run" / "run.rrd").exists()
    assert said == []


def _stop(receiver: subprocess.Popen[bytes]) -> None:
    """End the receiver; what it got stands in its file even if it does not heed the request."""
    receiver.send_signal(signal.SIGINT)
    try:
        receiver.wait(30)
    except subprocess.TimeoutExpired:
        receiver.kill()


def test_an_interrupted_run_has_one_recording_which_never_holds_less(session: Path, tmp_path: Path):
    out, profile, registry = tmp_path / "run", api.load_profile(), Registry.discover()

    def measure(until: int, **options: bool) -> list[int]:
        """Measure so many frame sets; those that are recorded then."""

        def stop(done: int, total: int | None) -> None:
            if done == until < SETS:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt) if until < SETS else nullcontext():
            api.run(session, out, profile, registry, api.RunOptions(**options), progress=stop)
        assert [path.name for path in out.glob("*.rrd*")] == ["run.rrd"]
        stored = read_recording(out / "run.rrd")
        return list(column(stored[entities.error("x")], "Scalars:scalars"))

    assert measure(5) == list(range(5))
    assert measure(SETS, resume=True) == list(range(SETS))
    whole = (out / "run.rrd").stat().st_mtime_ns
    assert measure(SETS, resume=True) == list(range(SETS))
    assert (out / "run.rrd").stat().st_mtime_ns == whole, "nothing was left to measure"


@pytest.mark.parametrize("damage", ["ends in zeros", "gone"])
def test_a_broken_recording_of_a_finished_run_is_made_anew_from_its_tables(
    measured: Path, session: Path, tmp_path: Path, damage: str
) -> None:
    out, path, notes = tmp_path / "run", tmp_path / "run" / "run.rrd", list[str]()
    shutil.copytree(measured, out)
    data = path.read_bytes()
    path.write_bytes(data[:-4096] + bytes(4096))
    if damage == "gone":
        path.unlink()
    given = session, out, api.load_profile(), Registry.discover()
    api.run(*given, api.RunOptions(resume=True), on_note=notes.append)
    assert notes[0] == f"resumed at frame set {SETS} of {SETS}"
    assert "run.rrd: made anew from the tables up to there, without pictures" in notes[1]
    stored = read_recording(path)
    assert list(column(stored[entities.error("x")], "Scalars:scalars")) == list(range(SETS))
    api.run(*given, api.RunOptions(resume=True), on_note=notes.append)
    assert len(notes) == 3, "it is whole now"

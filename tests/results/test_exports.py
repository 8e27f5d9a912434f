"""Every export is read back by a program that is not ours."""

from __future__ import annotations

import builtins
import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from measure import api
from measure.errors import ConfigError, RunError
from measure.host import plain_names
from measure.results import Run
from measure.results.exporting import export_run
from measure.session import able, formats
from measure_formats import tables
from tests.results.conftest import BODY, measurement, true_pose, written

LOST = (3, 4)
COUNT = 12
HERE = [i for i in range(COUNT) if i not in LOST]


@pytest.fixture
def run(folder: Path) -> Run:
    return written(folder, [measurement(i, lost=i in LOST) for i in range(COUNT)])


def _truth():
    return [true_pose(i / 30) for i in HERE]


def test_csv(run: Run, tmp_path: Path) -> None:
    path = export_run([run], "csv", tmp_path / "x.csv")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(COUNT))
    assert rows[3]["x_mm"] == rows[3]["cov_x_mm_x_mm"] == ""
    assert rows[3]["status"] == "lost"
    for row, pose in zip([rows[i] for i in HERE], _truth(), strict=True):
        found = [float(row[name]) for name in ("x_mm", "y_mm", "z_mm")]
        assert np.allclose(found, pose.translation, atol=1e-8)
        assert float(row["cov_x_mm_x_mm"]) == 0.01
        assert float(row["cov_rz_rad_rz_rad"]) == 1e-6


def test_tum(run: Run, tmp_path: Path) -> None:
    path = export_run([run], "tum", tmp_path / "x.tum")
    values = np.loadtxt(path)
    assert values.shape == (len(HERE), 8)
    assert np.allclose(values[:, 0], np.array(HERE) / 30)
    for row, pose in zip(values, _truth(), strict=True):
        assert np.allclose(1000 * row[1:4], pose.translation, atol=1e-8)
        turn = Rotation.from_quat(row[4:]) * Rotation.from_matrix(pose.rotation).inv()
        assert turn.magnitude() < 1e-8


def test_tum_is_read_by_evo(run: Run, tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path = export_run([run], "tum", tmp_path / "x.tum")
    trajectory = file_interface.read_tum_trajectory_file(str(path))
    assert trajectory.check()[0]
    assert trajectory.num_poses == len(HERE)


def test_trc(run: Run, tmp_path: Path) -> None:
    lines = export_run([run], "trc", tmp_path / "x.trc").read_text().splitlines()
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert (head["NumFrames"], head["NumMarkers"], head["Units"]) == ("12", "4", "mm")
    assert float(head["DataRate"]) == pytest.approx(30)
    names = [name for name in lines[3].split("\t")[2:] if name]
    assert names == ["green", "yellow", "red", "body_origin"]
    assert lines[4].split("\t")[2:5] == ["X1", "Y1", "Z1"]
    rows = [line.split("\t") for line in lines[6:]]
    assert len(rows) == COUNT
    assert rows[3][2:] == [""] * 12
    for i, pose in zip(HERE, _truth(), strict=True):
        values = np.array(rows[i], dtype=float)
        assert values[0] == i + 1
        assert np.allclose(values[2:].reshape(4, 3)[:3], pose.apply(BODY.centers), atol=1e-5)
        assert np.allclose(values[11:], pose.translation, atol=1e-5)


def test_c3d(run: Run, tmp_path: Path) -> None:
    c3d = pytest.importorskip("c3d")
    path = export_run([run], "c3d", tmp_path / "x.c3d")
    with path.open("rb") as file:
        reader = c3d.Reader(file)
        assert reader.point_rate == pytest.approx(30)
        assert [label.strip() for label in reader.point_labels] == [*BODY.names, "body_origin"]
        assert [label.strip() for label in reader.analog_labels] == ["time_s", "frame"]
        assert reader.get("POINT:UNITS").string_array[0].strip() == "mm"
        frames = list(reader.read_frames())
    assert len(frames) == COUNT
    for i, (_, points, analog) in enumerate(frames):
        assert float(analog[0, 0]) == pytest.approx(i / 30, abs=1e-6)
        assert float(analog[1, 0]) == i
        if i in LOST:
            assert np.all(points[:, 3] < 0), "an unlocated marker is invalid"
            continue
        pose = true_pose(i / 30)
        assert np.all(points[:, 3] >= 0)
        assert np.allclose(points[:3, :3], pose.apply(BODY.centers), atol=1e-4)
        assert np.allclose(points[3, :3], pose.translation, atol=1e-4)


def test_what_c3d_cannot_count_is_refused(run: Run, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("ezc3d")
    times_s = np.arange(65_535) / 30
    long = tables.Markers(("a",), times_s, np.zeros((65_535, 1, 3)), 30.0)
    monkeypatch.setattr(tables, "markers_of", lambda _: long)
    with pytest.raises(RunError, match=r"x.c3d: 65535 frame sets, and programs read 65534"):
        export_run([run], "c3d", tmp_path / "x.c3d")
    assert not (tmp_path / "x.c3d").exists()


def test_mcap(run: Run, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    pytest.importorskip("rosbags")
    path = export_run([run], "mcap", tmp_path / "x.mcap")
    seen: dict[str, list] = {}
    with path.open("rb") as file:
        opened = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, message, decoded in opened.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append((message.log_time, decoded))
    assert sorted(seen) == ["/balls/green", "/balls/red", "/balls/yellow", "/body/pose", "/tf"]
    assert len(seen["/body/pose"]) == len(HERE)
    for (stamp, message), i in zip(seen["/body/pose"], HERE, strict=True):
        pose = true_pose(i / 30)
        assert stamp == pytest.approx(i / 30 * 1e9, abs=1)
        place = message.pose.pose.position
        assert np.allclose([place.x, place.y, place.z], pose.translation / 1000, atol=1e-12)
        q = message.pose.pose.orientation
        assert np.allclose([q.w, q.x, q.y, q.z], pose.quat_wxyz, atol=1e-12)
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        assert np.allclose(np.diag(covariance), [1e-8] * 3 + [1e-6] * 3)
        assert message.header.frame_id == "world"
    tf = seen["/tf"][0][1].transforms[0]
    assert (tf.header.frame_id, tf.child_frame_id) == ("world", "body")
    green = seen["/balls/green"][0][1].point
    expected = true_pose(0.0).apply(BODY.centers)[0] / 1000
    assert np.allclose([green.x, green.y, green.z], expected, atol=1e-9)


def test_what_cannot_be_exported_is_explained(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no export format is called 'c3'; did you mean c3d"):
        export_run([run], "c3", tmp_path / "x")
    export_run([run], "tum", tmp_path / "x.tum")
    with pytest.raises(RunError, match="cannot be written"):
        export_run([run], "tum", tmp_path / "none" / "x.tum")


@pytest.mark.parametrize(("file_format", "module"), [("c3d", "ezc3d"), ("mcap", "rosbags")])
def test_what_was_not_written_is_not_said_to_be(run, tmp_path, file_format, module) -> None:
    """Their libraries say nothing of it."""
    pytest.importorskip(module)
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "none" / "x", tmp_path / "folder"):
        with pytest.raises(RunError, match="cannot be written"):
            export_run([run], file_format, path)
    assert not list((tmp_path / "folder").iterdir())
    if file_format == "c3d" and Path("/dev/full").exists():
        with pytest.raises(RunError, match="cannot be written: No space left"):
            export_run([run], file_format, Path("/dev/full"))


def test_a_c3d_that_was_cut_is_not_said_to_be_whole(run, tmp_path, monkeypatch) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    real = ezc3d.c3d.write

    def cut(self, path: str) -> None:
        real(self, path)
        Path(path).write_bytes(Path(path).read_bytes()[:600])

    monkeypatch.setattr(ezc3d.c3d, "write", cut)
    with pytest.raises(RunError, match="is the disk full"):
        export_run([run], "c3d", tmp_path / "x.c3d")
    assert not (tmp_path / "x.c3d").exists()


@pytest.mark.parametrize("file_format", able("write_run"))
def test_a_folder_whose_name_is_no_text(run: Run, tmp_path: Path, file_format: str) -> None:
    pytest.importorskip({"c3d": "ezc3d", "mcap": "rosbags"}.get(file_format, "numpy"))
    folder = tmp_path / "s\udcff"
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system knows no such names")
    plain = export_run([run], file_format, tmp_path / "x").read_bytes()
    if file_format == "mcap":  # which holds the moment it was written
        assert len(export_run([run], file_format, folder / "x").read_bytes()) == len(plain)
    else:
        assert export_run([run], file_format, folder / "x").read_bytes() == plain


@pytest.mark.parametrize("name", ["poses.csv", "run.toml", "poses.parquet", "x/../body.toml"])
def test_a_runs_own_files_are_not_replaced(run: Run, name: str) -> None:
    (run.path / "x").mkdir(exist_ok=True)
    before = (run.path / name).read_bytes()
    with pytest.raises(ConfigError, match="is one of the files to be read"):
        api.export(run.path, "csv", run.path / name, overwrite=True)
    assert (run.path / name).read_bytes() == before


def test_times_that_ros_does_not_know_are_refused(run, tmp_path) -> None:
    pytest.importorskip("rosbags")
    early = run.poses.set_column(1, "time_s", pa.array(run.times_s - 1.0))
    with pytest.raises(RunError, match=r"ROS knows no time -1 s.*time_offset_s"):
        export_run([replace(run, poses=early)], "mcap", tmp_path / "x.mcap")


def test_balls_have_topics_of_their_own() -> None:
    topics = plain_names(["ball 1", "ball-1", "红", "绿", "red"], "ball")
    assert len(set(topics.values())) == 5
    assert (topics["red"], topics["红"]) == ("red", "ball")


def test_a_run_without_a_pose_is_refused(folder: Path, tmp_path: Path) -> None:
    run = written(folder, [measurement(0, lost=True)])
    for name in able("write_run"):
        with pytest.raises(RunError, match="holds no pose"):
            export_run([run], name, tmp_path / "x")


@pytest.mark.parametrize(("name", "library"), [("c3d", "ezc3d"), ("mcap", "rosbags")])
def test_a_missing_library_is_named_with_its_extra(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, library: str
) -> None:
    real = builtins.__import__

    def without(wanted: str, *args, **kwargs):
        if wanted.split(".")[0] == library:
            raise ModuleNotFoundError(f"No module named '{library}'", name=library)
        return real(wanted, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(
        ConfigError, match=rf'needs {library}: .*"triball\[{formats()[name].extra}\]'
    ):
        export_run([run], name, tmp_path / "x")

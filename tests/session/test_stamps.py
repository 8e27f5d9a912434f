"""Tables of stamps: in any dialect the same, with the errors that they show, and their offsets."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from measure.errors import SessionError
from measure.session import open_streams
from measure.session.timestamps import (
    StampErrors,
    add_time_offsets,
    check_time_units,
    read_stamps,
    stamps_in_names,
)
from tests.session.conftest import write_recording

TIMES_S = [1700000000.0, 1700000000.033333, 1700000000.066667]
DIALECTS = {
    "comma": ",".join,
    "semicolon": lambda cells: ";".join(cells),
    "tab": lambda cells: "\t".join(cells),
    "semicolon and decimal comma": lambda cells: ";".join(cells).replace(".", ","),
    "tab and decimal comma": lambda cells: "\t".join(cells).replace(".", ","),
}


def table(join, times_s=TIMES_S):
    rows = [("frame", "time_s"), *((str(k), f"{t:.6f}") for k, t in enumerate(times_s))]
    return "\n".join(join(row) for row in rows) + "\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", DIALECTS)
def test_a_dialect_is_read_as_any_other(tmp_path, name, encoding):
    path = tmp_path / "cam0.csv"
    path.write_bytes(table(DIALECTS[name]).encode(encoding))
    stamps = read_stamps(path, "cam0")
    np.testing.assert_array_equal(stamps.frames, [0, 1, 2])
    np.testing.assert_allclose(stamps.times_s, TIMES_S, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "frame,secs,nsecs\n0,1700000000,0\n1,1700000000,33333000\n2,1700000000,66667000\n",
        "sec;nanosec;frame\n1700000000;0;0\n1700000000;33333000;1\n1700000000;66667000;2\n",
        (
            "frame,time_s\n0,2023-11-14T22:13:20Z\n1,2023-11-14T22:13:20.033333Z\n"
            "2,2023-11-14T23:13:20.066667+01:00\n"
        ),
        (
            "frame,time_s\n0,2023-11-14 22:13:20\n1,2023-11-14 22:13:20.033333\n"
            "2,2023-11-14 22:13:20.066667\n"
        ),
    ],
    ids=["ROS 1", "ROS 2", "ISO 8601", "ISO 8601 without a zone"],
)
def test_times_of_ros_and_of_iso_8601(tmp_path, text):
    (tmp_path / "cam0.csv").write_text(text)
    np.testing.assert_allclose(read_stamps(tmp_path / "cam0.csv", "cam0").times_s, TIMES_S)


@pytest.mark.parametrize(
    ("heading", "unit_s"),
    [
        ("timestamp", 1.0),
        ("t", 1.0),
        ("Time (s)", 1.0),
        ("Time (Seconds)", 1.0),
        ("time_ms", 1e-3),
        ("Timestamp [us]", 1e-6),
        ("sensor_timestamp_ns", 1e-9),
        ("stamp", 1.0),
        ("frame_time_usec", 1e-6),
    ],
)
def test_the_heading_names_the_time_and_its_unit(tmp_path, heading, unit_s):
    rows = [f"{k};{(t - TIMES_S[0]) / unit_s:.6f}" for k, t in enumerate(TIMES_S)]
    (tmp_path / "cam0.csv").write_text("\n".join([f"frame;{heading}", *rows]) + "\n")
    found = read_stamps(tmp_path / "cam0.csv", "cam0").times_s
    np.testing.assert_allclose(found, np.array(TIMES_S) - TIMES_S[0], atol=1e-6)


def test_the_session_says_which_column_is_the_time(tmp_path):
    (tmp_path / "cam0.csv").write_text("frame,clock,exposed_ms,timestamp\n0,7,0,3\n1,8,40,4\n")
    found = read_stamps(tmp_path / "cam0.csv", "cam0", "exposed_ms")
    np.testing.assert_allclose(found.times_s, [0.0, 0.04])
    with pytest.raises(SessionError, match="the header lacks exposed_s; it must hold frame,time_s"):
        read_stamps(tmp_path / "cam0.csv", "cam0", "exposed_s")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,timestamp,time_ns\n0,0,5\n", "which of timestamp and time_ns holds it? Head it"),
        ("frame,time_s\n0,0.1\n1,no\n2,no\n3,0.4\n", "3: time_s is 'no', not a number (and 1 row"),
        ("frame,time_s\n0,0,5\n1,0,6\n2,0,7\n", "2: 3 cells under 2 headings (and 2 rows more"),
        ("frame,time_s\n0,1.234,5\n", "2: 3 cells under 2 headings: are decimal commas"),
        ("frame;time_s\n0;1.234,5\n", "2: time_s is '1.234,5', not a number"),
    ],
)
def test_what_may_mean_two_things_is_refused(tmp_path, text, said):
    (tmp_path / "cam0.csv").write_text(text)
    with pytest.raises(SessionError) as refused:
        read_stamps(tmp_path / "cam0.csv", "cam0")
    assert said in str(refused.value)


TRUE_S = np.arange(300) / 30


@pytest.mark.parametrize("quantum_s", [0.001, 0.01, 0.02, 1 / 64])
def test_rounded_stamps_have_the_error_of_rounding(quantum_s):
    stamps = np.unique(np.round(TRUE_S / quantum_s) * quantum_s)
    found = StampErrors.of(np.round(stamps, 6))
    np.testing.assert_allclose(found.sd_s, quantum_s / np.sqrt(12))
    assert any("rounded" in note for note in found.notes) == (quantum_s > 0.005)


def test_times_of_arrival_have_the_scatter_of_their_delays():
    rng = np.random.default_rng(1)
    stamps = TRUE_S + 0.05 + rng.normal(scale=0.003, size=len(TRUE_S))
    stamps[100] += 0.02  # one was held up
    found = StampErrors.of(stamps)
    assert np.median(found.sd_s) == pytest.approx(0.003, rel=0.35)
    assert found.sd_s[100] > 0.015
    assert any("arrival" in note for note in found.notes)


@pytest.mark.parametrize(
    "stamps",
    [
        TRUE_S,
        np.arange(300) / 25,
        np.delete(TRUE_S, [40, 41, 70]),
        np.delete(np.arange(300) / 25, [40, 41, 70]),
        np.cumsum(np.repeat([0.033, 0.04, 0.05], 100)),  # exposures grow as it gets dark
        np.cumsum(np.random.default_rng(2).uniform(0.03, 0.036, 300)),  # steps of their own
        TRUE_S[:5],
    ],
    ids=["even", "40 ms", "gaps", "gaps of 40 ms", "slower", "wandering", "few"],
)
def test_stamps_that_show_no_error_have_none(stamps):
    found = StampErrors.of(stamps)
    assert np.all(found.sd_s < 4e-4)


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_cameras_in_different_units_are_refused(factor):
    with pytest.raises(SessionError, match=r"'b' are .* one is in another unit; write seconds"):
        check_time_units({"a": 0.0333, "b": 0.0333 * factor, "c": 0.034})
    check_time_units({"a": 0.0333, "b": 0.2, "c": float("inf")})


TEXT = """# by hand
[session]
name = "s"

[[cameras]]  # left
name = "a"
video = "a.mp4"

[[cameras]]
time_offset_s = 0.5  # measured
name = "b"
video = "b.mp4"

[robot]
log = "x"
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "session.toml"
    path.write_text(TEXT)
    return path


def test_offsets_are_added_and_the_rest_stays(file):
    text = add_time_offsets(file, {"a": -1.25, "b": 0.25}, overwrite=True)
    cameras = tomllib.loads(text)["cameras"]
    assert [camera["time_offset_s"] for camera in cameras] == [-1.25, 0.75]
    kept = [line for line in text.splitlines() if "time_offset_s" not in line]
    assert kept == [line for line in TEXT.splitlines() if "time_offset_s" not in line]
    assert "time_offset_s = 0.750000  # measured" in text


def test_an_offset_is_never_replaced_unasked(file):
    with pytest.raises(
        SessionError, match=r"b has time_offset_s = 0\.5 already: --overwrite makes"
    ):
        add_time_offsets(file, {"a": 0.0, "b": 1.0})
    assert file.read_text() == TEXT


def test_cameras_written_otherwise_are_left_to_the_user(file):
    file.write_text('cameras = [{name = "a"}, {name = "b"}]\n[session]\n')
    with pytest.raises(SessionError, match=r"or add to their times: a \+0\.100000, b \+0"):
        add_time_offsets(file, {"a": 0.1, "b": 0.0})


NS = [1600000000000000000 + round(k * 1e9 / 30) for k in range(6)]
LISTS = {
    "EuRoC": lambda n: "#timestamp [ns],filename\n" + "".join(f"{t},{t}.jpg\n" for t in n),
    "TUM": lambda n: "# timestamp filename\n" + "".join(f"{t / 1e9:.6f} rgb/{t}.jpg\n" for t in n),
    "numbers": lambda n: "frame,time_s\n" + "".join(f"{t},{t / 1e9:.6f}\n" for t in n),
    "none": None,
}


@pytest.mark.parametrize("kind", LISTS)
def test_pictures_named_by_their_times_are_paired_with_them(tmp_path, kind):
    write_recording(tmp_path)
    for ns, file in zip(NS, sorted((tmp_path / "cam1").iterdir()), strict=True):
        file.rename(file.with_stem(str(ns)))
    (tmp_path / "cam1" / f"{NS[2]}.jpg").unlink()
    session = tmp_path / "session.toml"
    if kind == "none":
        session.write_text(session.read_text().replace('timestamps = "cam1.csv"\n', ""))
    else:
        (tmp_path / "cam1.csv").write_text(LISTS[kind](NS))
    with open_streams(tmp_path) as streams:
        cam = streams["cam1"]
        times_s = [ns / 1e9 for k, ns in enumerate(NS) if k != 2]
        np.testing.assert_allclose(cam.times_s, times_s, atol=1e-6)
        assert [file.stem for file in cam.files] == [str(ns) for k, ns in enumerate(NS) if k != 2]


def test_numbers_that_are_no_times_are_none():
    assert stamps_in_names(["000001.jpg", "000002.jpg"]) is None
    assert stamps_in_names(["1600000000000.jpg", "frame.jpg"]) is None
    assert stamps_in_names(["1600000000100.jpg", "1600000000000.jpg"]) is None
    found = stamps_in_names([f"cam_{33333333 * k:012d}.png" for k in range(3)])
    np.testing.assert_allclose(found.times_s, [0, 0.033333333, 0.066666666])


def test_rows_that_two_threads_wrote_are_taken_in_the_order_of_their_frames(tmp_path):
    rows = ["0,0.0", "2,0.2", "1,0.1", "3,0.3"]
    (tmp_path / "cam0.csv").write_text("\n".join(["frame,time_s", *rows]) + "\n")
    found = read_stamps(tmp_path / "cam0.csv", "cam0")
    assert found.frames.tolist() == [0, 1, 2, 3]
    assert found.times_s.tolist() == [0.0, 0.1, 0.2, 0.3]
    assert "2 rows were out of order" in found.notes[0]
    (tmp_path / "cam1.csv").write_text("\n".join(["frame,time_s", *sorted(rows)]) + "\n")
    assert not read_stamps(tmp_path / "cam1.csv", "cam1").notes
    (tmp_path / "cam0.csv").write_text("frame,time_s\n0,0.0\n2,0.1\n1,0.2\n")
    with pytest.raises(SessionError, match=r"cam0\.csv:3: time goes backwards"):
        read_stamps(tmp_path / "cam0.csv", "cam0")

"""Tables in the dialects that spreadsheets, ROS and loggers write are the same table."""

from __future__ import annotations

import numpy as np
import pytest

from measure.errors import SessionError
from measure.session.timestamps import read_stamps

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
        ("frame,time_s\n0,yesterday\n", "2: time_s is 'yesterday', not a number"),
        ("frame,secs\n0,17\n", "1: the header lacks time_s"),
    ],
)
def test_what_may_mean_two_things_is_refused(tmp_path, text, said):
    (tmp_path / "cam0.csv").write_text(text)
    with pytest.raises(SessionError) as refused:
        read_stamps(tmp_path / "cam0.csv", "cam0")
    assert said in str(refused.value)

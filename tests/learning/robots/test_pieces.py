"""Logs and tables read in pieces give what they give in one, and take no memory for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure.robots import RobotLog
from measure_learning.robots import LogFile, find_schema, log_pieces, read_log, write_log
from measure_learning.robots import tables as module
from measure_learning.robots.tables import TableFile

SCHEMA = find_schema("dvrk-psm")


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PIECE_ROWS", 7)
    monkeypatch.setattr(module, "_BLOCK_BYTES", 2000)


def log_of(count: int) -> RobotLog:
    states = np.random.default_rng(1).integers(-500, 500, (count, len(SCHEMA.names))) / 64
    states[3, 1], states[20, 2] = np.nan, np.inf
    return RobotLog(SCHEMA, 10.0 + np.arange(count) / 1000, states)


@pytest.mark.parametrize("name", ["log.parquet", "log.csv"])
def test_a_log_in_pieces_is_the_log(tmp_path: Path, name: str) -> None:
    log = log_of(50)
    write_log(tmp_path / name, log)
    sizes = [len(times) for times, _ in log_pieces(tmp_path / name, SCHEMA)]
    assert max(sizes) == 7
    whole, file = read_log(tmp_path / name, SCHEMA), LogFile(tmp_path / name, SCHEMA)
    rows = np.array([49, 0, 20, 20, 7, 6])
    for one in (whole, file):
        np.testing.assert_array_equal(one.times_s, log.times_s)
        np.testing.assert_array_equal(one.complete, log.complete)
        np.testing.assert_array_equal(one.broken, log.broken)
        np.testing.assert_array_equal(one.reported_mm, log.reported_mm)
        np.testing.assert_array_equal(one.states_at(rows), log.states[rows])


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ({13: 1.0}, "time runs backwards at row 13"),
        ({14: 1.0}, "time runs backwards at row 14"),
        ({21: np.nan}, "row 22 has no time"),
        (dict.fromkeys(range(30), 10.0), "holds 1 states; a log needs at least two"),
    ],
)
def test_faults_are_named_by_their_row_in_the_file(
    tmp_path: Path, times: dict[int, float], words: str
) -> None:
    log = log_of(30)
    changed = log.times_s.copy()
    changed[list(times)] = list(times.values())
    write_log(tmp_path / "log.parquet", RobotLog(SCHEMA, changed, log.states))
    with pytest.raises(EstimatorError, match=words):
        LogFile(tmp_path / "log.parquet", SCHEMA)


def test_a_log_without_rows(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(",".join(("time_s", *SCHEMA.names)) + "\n")
    with pytest.raises(EstimatorError, match="holds 0 states"):
        read_log(tmp_path / "log.csv", SCHEMA)


def test_a_repeated_time_counts_once_also_across_pieces(tmp_path: Path) -> None:
    log = log_of(30)
    times = log.times_s.copy()
    times[7] = times[6]
    write_log(tmp_path / "log.parquet", RobotLog(SCHEMA, times, log.states))
    np.testing.assert_array_equal(
        LogFile(tmp_path / "log.parquet", SCHEMA).times_s, np.delete(times, 7)
    )


def test_types_are_those_of_the_whole_file(tmp_path: Path) -> None:
    """The first rows are whole numbers, or empty; later ones are not."""
    path = tmp_path / "table.csv"
    rows = [("", 1, "7", 5)] * 300 + [("2.5", 1.5, "x", 5)] * 300
    path.write_text("a,b,run,c\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    pieces = list(TableFile.open(path).pieces(("a", "b"), ("run",)))
    numbers = np.concatenate([piece.numbers("a", "b") for piece in pieces])
    assert len(numbers) == 600
    assert np.isnan(numbers[:300, 0]).all()
    np.testing.assert_array_equal(numbers[300:], np.tile([2.5, 1.5], (300, 1)))
    assert [label for piece in pieces for label in piece.labels("run")][299:301] == ["7", "x"]


def test_text_among_numbers_is_named_by_its_line(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("a,b\n" + "1,2\n" * 500 + "1,N/A\n" * 2 + "1,two\n")
    with pytest.raises(EstimatorError, match=r"table.csv:504: b is 'two', not a number"):
        list(TableFile.open(path).pieces(("a", "b")))

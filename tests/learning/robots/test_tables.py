"""Tables that people made: every mistake is one line that says which column and which row."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from measure.errors import EstimatorError
from measure.tables import read_number_table
from measure_learning.robots import find_schema, read_log
from measure_learning.robots.tables import Table


def table(folder: Path, **columns: object) -> Table:
    parquet.write_table(pa.table(columns), folder / "table.parquet")
    return Table.read(folder / "table.parquet")


def test_numbers_of_any_kind(tmp_path: Path) -> None:
    given = table(
        tmp_path,
        whole=pa.array([1, None, 3], pa.int16()),
        single=pa.array([0.5, 1.5, None], pa.float32()),
        yes=[True, False, None],
        none=pa.nulls(3),
        shared=pa.array([2.0, 2.0, 4.0]).dictionary_encode(),
        stamp_ns=[1_600_000_000_000_000_001, 2, 3],
    )
    assert given.numbers("stamp_ns")[0, 0] == 1.6e18
    np.testing.assert_array_equal(
        given.numbers("whole", "single", "yes", "none", "shared"),
        [[1, 0.5, 1, np.nan, 2], [np.nan, 1.5, 0, np.nan, 2], [3, np.nan, np.nan, np.nan, 4]],
    )


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (["1.5", "-", "x"], r"table.parquet: column 'a' holds text, '-' in row 2, where numbers"),
        ([[1.0], [2.0], [3.0]], r"table.parquet: column 'a' holds list<.*>, where numbers"),
        ([datetime(2026, 1, 1)] * 3, r"table.parquet: column 'a' holds timestamp.*, where numbers"),
    ],
)
def test_what_is_no_number(tmp_path: Path, column: list[object], message: str) -> None:
    with pytest.raises(EstimatorError, match=message):
        table(tmp_path, a=column).numbers("a")


@pytest.mark.parametrize(
    "text",
    [
        "time_s,a\n0.5,1\n1.5,-2.5\n",
        "time_s;a\n0,5;1\n1,5;-2,5\n",
        "time_s\ta\r\n0.5\t1\r\n1.5\t-2.5\r\n",
        "time_s a\n0.5 1\n1.5 -2.5\n",
        "# of a robot\n#time_s,a\n0.5,1\n1.5,-2.5\n",
        "# of a robot\ntime_s,name,a\n0.5,x,1\n1.5,y,-2.5\n",
        "#time_s,name,a\n0.5,x,1\n1.5,y,-2.5\n",
        "\ntime_s, a\n0.5, 1\n\n1.5, -2.5\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_texts_are_read_alike_whole_and_line_by_line(
    text: str, encoding: str, tmp_path: Path
) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode(encoding))
    columns = read_number_table(path, ("time_s", "a")).columns
    np.testing.assert_array_equal(np.stack([*columns.values()], axis=1), [[0.5, 1.0], [1.5, -2.5]])
    np.testing.assert_array_equal(Table.read(path).numbers("time_s", "a"), [[0.5, 1], [1.5, -2.5]])


def test_columns_that_are_missing_or_there_twice(tmp_path: Path) -> None:
    with pytest.raises(EstimatorError, match=r"lacks 1 of 2 columns: b; it has a, c"):
        table(tmp_path, a=[1], c=[2]).numbers("a", "b")
    content = pa.table([pa.array([1]), pa.array([2])], names=["a", "a"])
    with pytest.raises(EstimatorError, match="column 'a' is there twice"):
        Table(tmp_path / "given.csv", content).numbers("a")


def test_labels_are_words_in_every_row(tmp_path: Path) -> None:
    given = table(tmp_path, good=["x", "y"], holed=["x", None], lists=[["x"], ["y"]])
    assert given.labels("good") == ["x", "y"]
    with pytest.raises(EstimatorError, match="column 'holed' is empty in row 2"):
        given.labels("holed")
    with pytest.raises(EstimatorError, match=r"column 'lists' holds list<.*>, not words"):
        given.labels("lists")


def test_a_log_with_a_row_without_time(tmp_path: Path) -> None:
    columns = {name: np.zeros(4) for name in find_schema("dvrk-psm").names}
    table(tmp_path, time_s=[0.0, 1.0, None, 3.0], **columns)
    with pytest.raises(EstimatorError, match=r"table.parquet: row 3 has no time"):
        read_log(tmp_path / "table.parquet", find_schema("dvrk-psm"))

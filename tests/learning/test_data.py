"""Files of data and splits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure.host import Dataset
from measure_learning.core import files, join, same_robot, split_by_trajectory
from measure_learning.robots import find_schema


def test_a_data_set_is_written_and_read(small: Dataset, tmp_path: Path) -> None:
    path = tmp_path / "data.parquet"
    files.write_dataset(path, small, [], "a test")
    again = files.read_dataset(path)
    assert again.names == small.names
    np.testing.assert_allclose(again.states, small.states, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(again.errors_mm, small.errors_mm)
    np.testing.assert_array_equal(again.usable, small.usable)
    np.testing.assert_array_equal(again.covariances, small.covariances)
    assert again.schema.to_dict() == small.schema.to_dict()
    assert again.digest() == small.digest()
    assert (tmp_path / "data.card.json").exists()


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("ex_mm", float("nan"), "row 6 has a usable error that is no finite number"),
        ("cov_xx_mm2", None, "row 6 has a usable covariance that is no finite number"),
        ("pos_x", float("inf"), "row 6 has a state that is no finite number"),
        ("usable", None, "column 'usable' must say true or false in every row"),
        ("trajectory", None, "column 'trajectory' is empty in row 6"),
        ("time_s", -1.0, "time runs backwards at row 6, in trajectory 'session_4_00/000'"),
    ],
)
def test_a_data_set_with_a_hole_is_refused(
    small: Dataset, tmp_path: Path, column: str, value: float | None, message: str
) -> None:
    """It used to make estimates that were no numbers."""
    from pyarrow import parquet

    path = tmp_path / "data.parquet"
    files.write_dataset(path, replace(small, usable=np.ones(len(small), bool)), (), "a test")
    table = parquet.read_table(path)
    cells = table[column].to_pylist()
    cells[5] = value
    parquet.write_table(table.set_column(table.column_names.index(column), column, [cells]), path)
    with pytest.raises(EstimatorError, match=message):
        files.read_dataset(path)


def test_files_that_are_no_data_sets(small: Dataset, tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    with pytest.raises(EstimatorError, match="no such data set"):
        files.read_dataset(tmp_path / "none.parquet")
    (tmp_path / "junk.parquet").write_bytes(b"junk")
    with pytest.raises(EstimatorError, match="cannot be read"):
        files.read_dataset(tmp_path / "junk.parquet")
    schema = find_schema("dvrk-psm")
    columns = {name: np.zeros(20) for name in schema.names}
    labels = {
        "run": ["a"] * 20,
        "t_s": np.arange(20.0),
        **dict.fromkeys(("ex", "ey", "ez"), np.full(20, 3e-3)),
    }
    parquet.write_table(pa.table(columns | labels), tmp_path / "metres.parquet")
    with pytest.raises(EstimatorError, match="are they metres"):
        files.read_labelled(tmp_path / "metres.parquet", schema)
    with pytest.raises(EstimatorError, match="make one with `measure dataset`"):
        files.read_dataset(tmp_path / "metres.parquet")
    stranger = replace(small, schema=replace(small.schema, robot="other"))
    turned = replace(small.schema, features=small.schema.features[::-1])
    other = replace(small, schema=turned, names=tuple(f"{name}'" for name in small.names))
    for use in (join, same_robot):
        with pytest.raises(EstimatorError, match="several robots"):
            use([small, stranger])
        with pytest.raises(EstimatorError, match="with other features, units or kinematics"):
            use([small, other])


def test_poses_of_a_file_that_are_not_ok_are_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = ["0,1,2,3,ok", "1,1,2,3,flagged", "2,,,,lost", "3,4,5,6,ok"]
    path.write_text("\n".join(["time_s,x_mm,y_mm,z_mm,status", *rows]))
    positions = files.read_poses(path).positions_mm
    assert np.isfinite(positions).all(axis=1).tolist() == [True, False, False, True]


def test_a_split_shares_no_trajectory(small: Dataset) -> None:
    split = split_by_trajectory(small, seed=3)
    parts = [set(part.present()) for part in (split.train, split.validation, split.test)]
    assert set.union(*parts) == set(small.present())
    assert sum(map(len, parts)) == len(small.present())
    other = split_by_trajectory(small, seed=4)
    assert set(other.test.present()) != parts[2] or set(other.validation.present()) != parts[1]

"""Clocks, assembly, files and splits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Dataset
from measure.learning import (
    AssemblySettings,
    PoseTrack,
    assemble,
    estimate_offset,
    files,
    join,
    same_robot,
    split_by_rows,
    split_by_trajectory,
)
from measure.learning.simulated import recording
from measure.robots import RobotLog, psm_schema
from measure.robots.simulator import simulate


@pytest.fixture(scope="module")
def pair() -> tuple[PoseTrack, RobotLog]:
    return recording(simulate(30.0, 8, log_hz=100.0), "one", 8, frame_hz=30.0, clock_offset_s=1.5)


@pytest.mark.parametrize("offset", [-3.2, 0.0, 0.617])
def test_clock_offset_of_a_perfect_robot(offset: float) -> None:
    times = np.arange(0, 30, 0.01)
    path = np.stack(
        [20 * np.sin(0.9 * times), 15 * np.sin(1.7 * times + 1), 10 * np.sin(2.3 * times)], axis=1
    )
    noisy = path[::5] + np.random.default_rng(0).normal(0, 0.1, (600, 3))
    found = estimate_offset(times[::5], noisy, times + offset, path)
    assert found.offset_s == pytest.approx(offset, abs=5 * found.sd_s + 1e-3)
    assert found.sd_s < 2e-3


def test_clock_offset_of_the_simulated_robot(pair: tuple[PoseTrack, RobotLog]) -> None:
    """The tip follows its slack cables a little late, which no clock can tell from an offset."""
    track, log = pair
    found = estimate_offset(
        track.times_s, track.positions_mm, log.times_s, log.schema.position_mm(log.states)
    )
    assert 1.46 < found.offset_s < 1.505
    assert found.correlation > 0.95


def test_clocks_that_do_not_match(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    other, _ = recording(simulate(30.0, 9, log_hz=100.0), "other", 9, frame_hz=30.0)
    with pytest.raises(EstimatorError, match="no clock offset within 5 s"):
        assemble([(other, log)])
    sparse = replace(
        other,
        times_s=other.times_s[::30],
        positions_mm=other.positions_mm[::30],
        covariances=other.covariances[::30],
    )
    with pytest.raises(EstimatorError, match="Poses every 1 s hardly show speeds"):
        assemble([(sparse, log)])
    late = replace(track, times_s=track.times_s + 1000.0)
    with pytest.raises(EstimatorError, match="share less than 8 s"):
        assemble([(late, log)])


def cut(track: PoseTrack, log: RobotLog, start: float, stop: float) -> tuple[PoseTrack, RobotLog]:
    """What both recorded between two instants of the cameras' clock, if it is 1.5 s behind."""
    seen = (track.times_s >= start) & (track.times_s < stop)
    told = (log.times_s >= start + 1.5) & (log.times_s < stop + 1.5)
    return (
        PoseTrack("cut", track.times_s[seen], track.positions_mm[seen], track.covariances[seen]),
        RobotLog(log.schema, log.times_s[told], log.states[told]),
    )


def test_a_short_recording_is_matched_with_its_own_log_only() -> None:
    """Speeds of one hand resemble each other: half of the others' logs used to be believed."""
    pairs = [
        recording(simulate(12.0, seed, log_hz=100.0), "x", seed, frame_hz=15.0) for seed in range(5)
    ]
    cuts = [cut(*pair, 2.0, 11.0) for pair in pairs]
    for i, (track, _) in enumerate(cuts):
        for k, (_, log) in enumerate(cuts):
            if i == k:
                _, (facts,) = assemble([(track, log)])
                assert facts.clock is not None
                assert facts.clock.offset_s == pytest.approx(1.482, abs=0.03)
            else:
                with pytest.raises(EstimatorError, match=r"no clock offset|the motion fits"):
                    assemble([(track, log)])


def test_motion_that_repeats_itself_tells_no_offset() -> None:
    times = np.arange(0, 30, 0.01)
    path = np.stack([20 * np.sin(3 * times), 15 * np.cos(3 * times), 5 * np.sin(6 * times)], axis=1)
    with pytest.raises(EstimatorError, match=r"alike .* as it repeats itself"):
        estimate_offset(times[::5], path[::5], times + 0.5, path)
    faster = path + 10 * np.sin(0.1 * times**2)[:, None]
    found = estimate_offset(times[::5], faster[::5], times + 0.5, faster)
    assert found.offset_s == pytest.approx(0.5, abs=1e-3)


def test_gaps_say_nothing_of_the_offset(pair: tuple[PoseTrack, RobotLog]) -> None:
    """A log without numbers for five seconds, and cameras that lost the body for four."""
    track, log = pair
    states = log.states.copy()
    states[(log.times_s > 8) & (log.times_s < 13)] = np.nan
    positions = track.positions_mm.copy()
    positions[(track.times_s > 17) & (track.times_s < 21)] = np.nan
    holes = (replace(track, positions_mm=positions), replace(log, states=states))
    _, (whole,) = assemble([(track, log)])
    _, (gaps,) = assemble([holes])
    assert whole.clock is not None
    assert gaps.clock is not None
    assert gaps.clock.offset_s == pytest.approx(whole.clock.offset_s, abs=0.005)
    assert gaps.clock.correlation > 0.98


def test_doubtful_labels_are_marked(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    positions, covariances = track.positions_mm.copy(), track.covariances.copy()
    positions[100] += 15.0  # a false detection
    positions[200:210] = np.nan  # not seen
    covariances[300] *= 1e4  # hardly determined
    hole = (log.times_s > 20.0) & (log.times_s < 20.5)
    broken = RobotLog(log.schema, log.times_s[~hole], log.states[~hole])
    data, (facts,) = assemble(
        [(replace(track, positions_mm=positions, covariances=covariances), broken)]
    )
    assert (facts.not_measured, facts.outliers, facts.uncertain) == (10, 1, 1)
    assert 9 <= facts.no_state <= 14
    assert not data.usable[[100, 205, 300]].any()
    assert len(data) == facts.rows == len(track.times_s)
    assert facts.usable == data.usable.sum() == len(track.times_s) - 12 - facts.no_state


def test_labels_are_measured_minus_reported(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    data, _ = assemble([(track, log)], AssemblySettings(clock_offset_s=1.5))
    np.testing.assert_allclose(data.reported_mm + data.errors_mm, track.positions_mm, atol=1e-9)
    again, _ = assemble([(track, log)], AssemblySettings(clock_offset_s=1.5, history_hz=50.0))
    assert len(again) > 1.5 * len(data)
    assert again.usable.sum() == data.usable.sum()


@pytest.mark.parametrize(("factor", "word"), [(1e-3, "metres"), (1e3, "micrometres")])
def test_other_units_are_noticed(
    factor: float, word: str, pair: tuple[PoseTrack, RobotLog]
) -> None:
    track, log = pair
    with pytest.raises(EstimatorError, match=f"look like {word}"):
        assemble([(replace(track, positions_mm=track.positions_mm * factor), log)])


@pytest.mark.parametrize(
    ("turn", "shift_mm", "reason"),
    [
        (np.diag([1.0, 1, -1]), 0, "are mirror images of each other"),
        (np.eye(3)[[1, 0, 2]], 0, "are mirror images of each other"),
        (np.diag([1.0, -1, -1]), 0, "are turned by 1[78]. degrees"),
        (np.eye(3)[[2, 0, 1]], 0, "are turned by 1[12]. degrees"),
        (np.eye(3), 150, "lie 2[56]. mm apart"),
    ],
)
def test_positions_in_another_frame_are_refused(
    turn: Floats, shift_mm: float, reason: str, pair: tuple[PoseTrack, RobotLog]
) -> None:
    """Labels of 60 to 250 mm used to be handed on without a word."""
    track, log = pair
    other = replace(track, positions_mm=track.positions_mm @ turn.T + shift_mm)
    with pytest.raises(EstimatorError, match=reason):
        assemble([(other, log)], AssemblySettings(clock_offset_s=1.485))


def test_a_given_clock_offset_that_is_wrong_is_told(pair: tuple[PoseTrack, RobotLog]) -> None:
    track, log = pair
    with pytest.raises(EstimatorError, match=r"do not go together \(correlation 0.*clock offset"):
        assemble([(track, log)], AssemblySettings(clock_offset_s=5.0))


def test_a_robot_that_reports_to_stand_still(pair: tuple[PoseTrack, RobotLog]) -> None:
    """Labels as large as the whole motion would be learnt, if the clock offset is given."""
    track, log = pair
    still = replace(log, states=np.tile(log.states[0], (len(log.states), 1)))
    with pytest.raises(EstimatorError, match=r"a tip that stands still while .* moves by \d"):
        assemble([(track, still)], AssemblySettings(clock_offset_s=1.5))


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
    schema = psm_schema()
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
        with pytest.raises(EstimatorError, match="with other features, or in another order"):
            use([small, other])


def test_a_split_shares_no_trajectory(small: Dataset) -> None:
    split = split_by_trajectory(small, seed=3)
    parts = [set(part.present()) for part in (split.train, split.validation, split.test)]
    assert set.union(*parts) == set(small.present())
    assert sum(map(len, parts)) == len(small.present())
    other = split_by_trajectory(small, seed=4)
    assert set(other.test.present()) != parts[2] or set(other.validation.present()) != parts[1]


def test_one_trajectory_cannot_be_split(small: Dataset) -> None:
    with pytest.raises(EstimatorError, match="1 trajectory cannot be split"):
        split_by_trajectory(small.select(small.names[:1]))


def test_random_rows_leave_every_trajectory_in_every_part(small: Dataset) -> None:
    split = split_by_rows(small, seed=0)
    total = sum(part.usable.sum() for part in (split.train, split.validation, split.test))
    assert total == small.usable.sum()
    assert len(split.test) == len(small)

"""Clocks, and poses and states brought together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from measure.arrays import Floats
from measure.cli import main
from measure.errors import EstimatorError
from measure.host.dataset import recording_of
from measure.robots import RobotLog
from measure_learning.core import AssemblySettings, PoseTrack, assemble, estimate_offset, files
from measure_learning.core.simulated import recording
from measure_learning.robots import write_log
from measure_learning.simulator import Cables, simulate


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


@pytest.mark.parametrize("wear", [0.5, 1.0, 2.0])
def test_the_stated_uncertainty_of_the_clock_holds_the_delay_of_the_cables(wear: float) -> None:
    """Chance alone is a tenth of it: the interval that says only that held the truth never."""
    for seed in range(40, 44):
        run = simulate(30.0, seed, log_hz=50.0, cables=Cables(wear=wear))
        track, log = recording(run, "one", seed, frame_hz=15.0)
        found = estimate_offset(
            track.times_s, track.positions_mm, log.times_s, log.schema.position_mm(log.states)
        )
        assert abs(found.offset_s - 1.5) < 1.96 * found.sd_s
        assert found.sd_s < 0.06


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
    # Clocks of another origin are aligned at their starts, and searched from there.
    plain, found = (assemble([(one, log)])[1][0].clock for one in (track, late))
    assert found.offset_s == pytest.approx(plain.offset_s - 1000.0, abs=1e-3)


def test_runs_of_one_restart_are_one_recording(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """And a log without positions is said to have none of its own; negative control: with."""
    for seed in (1, 2, 3):
        track, log = recording(simulate(12.0, seed, log_hz=50.0), "", seed, frame_hz=10.0)
        columns = {"time_s": track.times_s} | dict(
            zip(("x_mm", "y_mm", "z_mm"), track.positions_mm.T, strict=True)
        )
        parquet.write_table(pa.table(columns), tmp_path / f"run{seed}.parquet")
        write_log(tmp_path / f"log{seed}.parquet", log)
    joints = parquet.read_table(tmp_path / "log2.parquet").drop_columns(["pos_x", "pos_y", "pos_z"])
    parquet.write_table(joints, tmp_path / "log2.parquet")
    words = [str(tmp_path / f"run{seed}.parquet") for seed in (1, 2, 3)]
    words += [w for k in (1, 2, 3) for w in ("--robot-log", str(tmp_path / f"log{k}.parquet"))]
    words += ["--robot", "raven", "--clock-offset-s", "1.5", "-o", str(tmp_path / "data.parquet")]
    names = [w for name in ("mon", "mon", "tue") for w in ("--restart-name", name)]
    assert main(["dataset", *words, *names]) == 0
    assert "log2.parquet: the tip is computed from the joints, by raven2-left" in caplog.text
    assert "log1" not in caplog.text
    data = files.read_dataset(tmp_path / "data.parquet")
    assert data.names == ("mon/run1", "mon/run2", "tue/run3")
    assert [recording_of(name) for name in data.names] == ["mon", "mon", "tue"]
    words += ["--overwrite", "--restart-name", "mon", "--restart-name", "tue"]
    assert main(["dataset", *words]) == 2
    assert "expected one name without '/' for all 3 runs" in capsys.readouterr().err


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


def test_states_that_are_no_numbers_count_as_not_recorded(pair: tuple[PoseTrack, RobotLog]) -> None:
    """One NaN used to make a data set that could not be learnt from."""
    track, log = pair
    states = log.states.copy()
    torque = log.schema.names.index("tau_0")
    states[1000, torque] = np.nan
    states[1500:1530, torque] = np.inf
    data, (facts,) = assemble([(track, replace(log, states=states))])
    assert np.isfinite(data.states).all()
    assert facts.bad_states == 31
    assert 4 <= facts.no_state <= 8
    assert facts.usable == len(track.times_s) - facts.no_state
    states[:, torque] = np.nan
    with pytest.raises(EstimatorError, match=r"0 states that are all numbers; feature 'tau_0'"):
        assemble([(track, replace(log, states=states))])


@pytest.mark.parametrize("given", [None, 1.5])
def test_a_log_of_much_more_than_the_recording(
    given: float | None, pair: tuple[PoseTrack, RobotLog]
) -> None:
    """What the robot did before used to count: the poses "looked like centimetres"."""
    track, log = pair
    times = np.concatenate([log.times_s[:1000] - 60, log.times_s])
    far = log.states[:1000].copy()
    far[:, log.schema.names.index("pos_x")] += np.linspace(0, 3e6, 1000)  # um
    longer = RobotLog(log.schema, times, np.concatenate([far, log.states]))
    data, _ = assemble([(track, longer)], AssemblySettings(clock_offset_s=given))
    assert data.usable.sum() > 0.95 * len(track.times_s)


@pytest.mark.parametrize("offset_s", [500.0, -40.0])
def test_a_clock_offset_that_leaves_nothing_in_common(
    offset_s: float, pair: tuple[PoseTrack, RobotLog]
) -> None:
    for hz in (0.0, 50.0):
        settings = AssemblySettings(clock_offset_s=offset_s, history_hz=hz)
        with pytest.raises(EstimatorError, match=rf"no pose has a state: .* {offset_s:g} s, the"):
            assemble([pair], settings)


@pytest.mark.parametrize("offset_s", [float("nan"), float("inf")])
def test_a_clock_offset_that_is_no_number(offset_s: float) -> None:
    with pytest.raises(EstimatorError, match="expected a number"):
        AssemblySettings(clock_offset_s=offset_s)


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
    assert gaps.clock.offset_s == pytest.approx(whole.clock.offset_s, abs=0.005)
    assert gaps.clock.correlation > 0.98


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("off_mm", [30.0, 3e3])
def test_false_detections_say_nothing_of_the_offset(
    pair: tuple[PoseTrack, RobotLog], off_mm: float, count: int
) -> None:
    """One was taken for the fastest motion, and the log for another recording's."""
    track, log = pair
    _, (whole,) = assemble([(track, log)])
    positions = track.positions_mm.copy()
    for at in (100, 200, 450):
        positions[at : at + count] += off_mm
    _, (facts,) = assemble([(replace(track, positions_mm=positions), log)])
    assert facts.clock.offset_s == pytest.approx(whole.clock.offset_s, abs=0.002)
    assert facts.outliers == whole.outliers + 3 * count


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
        (np.diag([1.0, -1, -1]), 0, r"a world turned by 1[78]\d\.\d deg .* `measure register"),
        (np.eye(3)[[2, 0, 1]], 0, r"a world turned by 1[12]\d\.\d deg .* explains them but for"),
        (np.eye(3), 150, r"shifted by 2[56]\d\.\d mm explains them .* --frame frame.toml"),
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

"""A log that is written faster than the robot answers: every answer counts once."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.registration import Arm, recorded, robot_toml, ur5e
from measure.robots import RobotLog
from measure_learning.api.pairing import open_logs
from measure_learning.core import assemble
from measure_learning.core.frames import RobotFrame
from measure_learning.core.registration import LoggedTrack, RegisterOptions, register
from measure_learning.robots import LogFile, StateLog, find_schema, write_log

LOST = np.random.default_rng(3).random(100_000) < 0.1


@pytest.fixture(scope="module")
def arm() -> Arm:
    """With a controller that knows its links, so that cameras alone leave something."""
    return recorded(3, seconds=40.0, frame_hz=8.0, true=ur5e())


def opened(folder: Path, log: RobotLog) -> LogFile:
    """The log as its file is read, with what is said of it."""
    write_log(folder / "log.csv", log)
    (folder / "robot.toml").write_text(robot_toml())
    schema = find_schema(str(folder / "robot.toml"))
    return open_logs([""], [folder / "log.csv"], schema, None)[0]


def held(log: RobotLog, source: Callable[[np.ndarray], np.ndarray]) -> RobotLog:
    return replace(log, states=log.states[source(np.arange(len(log.states)))])


def labels(arm: Arm, frame: RobotFrame, log: StateLog) -> tuple[float, float]:
    """RMS of the labels in mm, and by how much the clock is off in s."""
    data, (facts,) = assemble([(frame.to_base(arm.track), log)])
    assert facts.clock is not None
    off_s = facts.clock.offset_s - arm.clock_offset_s
    assert data.usable.mean() > 0.95
    return float(np.sqrt(np.mean(np.sum(data.errors_mm[data.usable] ** 2, axis=1)))), off_s


@pytest.fixture(scope="module")
def frame(arm: Arm) -> RobotFrame:
    return register([LoggedTrack(arm.track, arm.log)], RegisterOptions())


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (lambda i: i - i % 12, "92 % of its rows repeat .* answers 10.4 times"),
        (lambda i: i - i % 4, "75 % of its rows repeat .* answers 31.2 times"),
        (lambda i: np.where(i % 3 == 2, i - 1, i), "33 % of .* answers 83.[34] times"),
        (lambda i: np.maximum.accumulate(i * ~LOST[i]), "1[01] % of its .* answers 11[2345] "),
    ],
    ids=["10 Hz", "31 Hz", "every third", "packets lost"],
)
def test_answers_count_once(
    arm: Arm, frame: RobotFrame, tmp_path: Path, caplog: pytest.LogCaptureFixture,
    source: Callable[[np.ndarray], np.ndarray], words: str,
) -> None:  # fmt: skip
    with caplog.at_level(logging.WARNING):
        log = opened(tmp_path, held(arm.log, source))
    assert len(caplog.messages) == 1
    assert re.search(words, caplog.messages[0]), caplog.messages
    left_mm, off_s = labels(arm, frame, log)
    assert left_mm < 1.1 * labels(arm, frame, arm.log)[0]
    assert abs(off_s) < 5e-3  # a robot's answer is half its period old


def test_a_robot_that_answers_ten_times_a_second_is_registered(arm: Arm, tmp_path: Path) -> None:
    log = opened(tmp_path, held(arm.log, lambda i: i - i % 12))
    found = register([LoggedTrack(arm.track, log)], RegisterOptions())
    assert found.judgement["rms_mm"] < 0.2
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 0.5


def standing(*, abrupt: bool, decimals: int) -> RobotLog:
    """An arm that stands for two seconds at each of twenty places, as a log of rounded joints."""
    times = np.arange(0.0, 80.0, 0.02)
    place, share = np.divmod(times, 4.0)
    share = np.clip(share / 2.0, 0, 1)
    smooth = (share if abrupt else 10 * share**3 - 15 * share**4 + 6 * share**5)[:, None]
    corners = np.random.default_rng(1).uniform(-1, 1, (21, 6))[
        place.astype(int)[:, None] + [[0, 1]]
    ]
    q = np.round(corners[:, 0] * (1 - smooth) + corners[:, 1] * smooth, decimals)
    return RobotLog(recorded(0, seconds=1.0).log.schema, times, np.hstack([q, ur5e().tip_mm(q)]))


@pytest.mark.parametrize("abrupt", [False, True])
@pytest.mark.parametrize("decimals", [3, 12])
def test_a_robot_at_rest_repeats_itself_and_keeps_its_states(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, abrupt: bool, decimals: int
) -> None:
    log = standing(abrupt=abrupt, decimals=decimals)
    with caplog.at_level(logging.WARNING):
        found = opened(tmp_path, log)
    assert caplog.messages == []
    assert len(found.times_s) > 0.99 * len(log.times_s)
    rests = log.times_s % 4.0 > 2.1
    assert np.isin(log.times_s[rests], found.times_s).all()


def test_states_of_rows_are_those_of_the_file(arm: Arm, tmp_path: Path) -> None:
    log = held(arm.log, lambda i: i - i % 4)
    found = opened(tmp_path, log)
    rows = np.array([7, 0, 30])
    np.testing.assert_allclose(found.times_s[:40], log.times_s[: 4 * 40 : 4])
    np.testing.assert_allclose(found.states_at(rows), log.states[4 * rows], atol=1e-3)

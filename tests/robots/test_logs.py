from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure.robots import RobotLog, find_schema, psm_schema, raven_schema, read_log, write_log
from measure.robots.simulator import simulate


@pytest.fixture(scope="module")
def log() -> RobotLog:
    run = simulate(1.0, 3, log_hz=50.0)
    return RobotLog(raven_schema(), run.times_s + 1000.0, run.states)


def test_an_arm_has_118_numbers_and_the_message_240() -> None:
    assert len(raven_schema().names) == len(set(raven_schema().names)) == 118
    assert 2 * len(raven_schema().names) + 4 == 240
    assert sum(map(len, raven_schema().groups.values())) == 118


@pytest.mark.parametrize("name", ["log.parquet", "log.csv", "log.bag", "log.mcap", "log_ros2"])
def test_what_is_written_is_read(name: str, log: RobotLog, tmp_path: Path) -> None:
    write_log(tmp_path / name, log)
    again = read_log(tmp_path / name, log.schema)
    np.testing.assert_allclose(again.times_s, log.times_s, atol=1e-9)
    np.testing.assert_allclose(again.states, log.states, rtol=1e-6, atol=1e-6)


def test_missing_features_are_named(log: RobotLog, tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    keep = [i for i, name in enumerate(log.schema.names) if not name.startswith("tau")]
    poor = replace(log.schema, features=tuple(log.schema.features[i] for i in keep))
    write_log(path, RobotLog(poor, log.times_s, log.states[:, keep]))
    with pytest.raises(EstimatorError, match=r"lacks 8 of 119 columns: tau_0, tau_1"):
        read_log(path, log.schema)


def test_bad_logs_are_refused(log: RobotLog, tmp_path: Path) -> None:
    with pytest.raises(EstimatorError, match="no such robot log"):
        read_log(tmp_path / "none.parquet", log.schema)
    (tmp_path / "junk.bag").write_bytes(b"nothing")
    with pytest.raises(EstimatorError, match="cannot be read as a bag"):
        read_log(tmp_path / "junk.bag", log.schema)
    (tmp_path / "junk.parquet").write_bytes(b"nothing")
    with pytest.raises(EstimatorError, match="cannot be read"):
        read_log(tmp_path / "junk.parquet", log.schema)
    back = RobotLog(log.schema, log.times_s[::-1].copy(), log.states)
    write_log(tmp_path / "back.parquet", back)
    with pytest.raises(EstimatorError, match="runs backwards at row 1"):
        read_log(tmp_path / "back.parquet", log.schema)
    with pytest.raises(EstimatorError, match="bags hold RAVEN-II states"):
        read_log(tmp_path / "junk.bag", psm_schema())


GENERIC = """
robot = "two-link"
position = ["x", "y", "z"]
position_to_mm = 1000.0
features = [{name="a", unit="deg"}, {name="b", unit="deg"}, {name="x"}, {name="y"}, {name="z"}]
joints = [
  {feature = "a", scale = 0.017453292519943295, alpha_deg = 0},
  {feature = "b", scale = 0.017453292519943295, alpha_deg = 0, a_mm = 100},
]
tool_mm = [50, 0, 0]
"""


def test_a_robot_described_by_a_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(GENERIC)
    schema = find_schema(str(path))
    state = np.array([90.0, -90.0, 0.05, 0.1, 0.0])
    assert schema.chain is not None
    tip = schema.chain.tip_mm(schema.joint_positions(state))
    np.testing.assert_allclose(tip, [50.0, 100.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(schema.position_mm(state), tip, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"x", "y", "z"]', '"x", "y", "w"]', "no feature w"),
        ("tool_mm", "tool_m", "tool_m"),
        ('robot = "two-link"', "", "'robot'"),
    ],
)
def test_a_wrong_robot_file_is_explained(old: str, new: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(GENERIC.replace(old, new, 1))
    with pytest.raises(EstimatorError, match=reason):
        find_schema(str(path))

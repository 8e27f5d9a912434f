from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure_learning.robots import find_schema, raven_schema, read_log
from tests.bags import Bag


def test_an_arm_has_118_numbers_and_the_message_240() -> None:
    assert len(raven_schema().names) == len(set(raven_schema().names)) == 118
    assert 2 * len(raven_schema().names) + 4 == 240
    assert sum(map(len, raven_schema().groups.values())) == 118


# The robot's public control software, word for word; not taken from the program under test.
RAVEN_STATE = """
Header hdr
int32 runlevel
int32 sublevel
int32 last_seq
int32[2] type
int32[6] pos
float32[18] ori
float32[18] ori_d
int32[6] pos_d
duration dt
int32[16] encVals
int32[16] dac_val
float32[16] tau
float32[16] mpos
float32[16] jpos
float32[16] mvel
float32[16] jvel
float32[16] mpos_d
float32[16] jpos_d
float32[2] grasp_d
float32[16] encoffsets
float32[12] jac_vel
float32[12] jac_f
"""
COUNTS = (2, 6, 18, 18, 6, 16, 16, 16, 16, 16, 16, 16, 16, 16, 2, 16, 12, 12)  # without dt


@pytest.mark.parametrize(("arm", "place"), [("left", 0), ("right", 1)])
@pytest.mark.parametrize("name", ["log.bag", "log.mcap", "log_ros2"])
def test_each_number_of_the_robots_own_message_has_its_place(
    name: str, arm: str, place: int, tmp_path: Path
) -> None:
    """A bag written with rosbags alone, its 236 numbers counted from one, both arms filled."""
    path = tmp_path / name
    _write_counted(path, RAVEN_STATE)
    log = read_log(path, find_schema("raven" if arm == "left" else "raven-right"))
    wanted = []
    start = 1
    for count in COUNTS:
        half = count // 2
        wanted += range(start + place * half, start + (place + 1) * half)
        start += count
    assert start == 237  # with run level, sub-level, last_seq and dt they are 240
    np.testing.assert_array_equal(log.states[0], wanted)
    np.testing.assert_allclose(log.times_s, [100.0, 100.001])


def test_an_older_message_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "old.bag"
    _write_counted(path, RAVEN_STATE.replace("float32[12] jac_f\n", ""))
    with pytest.raises(EstimatorError, match=r"no field 'jac_f', expected 12"):
        read_log(path, raven_schema())


def _write_counted(path: Path, definition: str) -> None:
    text = definition.replace("Header hdr", "std_msgs/Header hdr")
    if path.suffix != ".bag":
        text = text.replace("duration dt", "builtin_interfaces/Duration dt")
    names = [line.split() for line in definition.split("\n") if "[" in line]
    values, start = {}, 1
    for (number, name), count in zip(names, COUNTS[: len(names)], strict=True):
        dtype = np.int32 if number.startswith("int32") else np.float32
        values[name] = np.arange(start, start + count, dtype=dtype)
        start += count
    with Bag(path, definitions={"raven_2/msg/raven_state": text}) as bag:
        for index in range(2):
            at_s = 100 + index / 1000
            state = {"runlevel": 3, "sublevel": 0, "last_seq": index, "hdr": bag.header(at_s)}
            state["dt"] = bag.make("builtin_interfaces/Duration", sec=0, nanosec=1_000_000)
            bag.send("/ravenstate", "raven_2/raven_state", at_s, **state, **values)


@pytest.mark.parametrize("file", ["metadata.yaml", "bag.db3"])
def test_a_pipe_in_the_folder_of_a_bag_is_refused(tmp_path: Path, file: str) -> None:
    bag = tmp_path / "bag"
    _write_counted(bag, RAVEN_STATE)
    assert len(read_log(bag, raven_schema()).states) == 2
    (bag / file).unlink()
    os.mkfifo(bag / file)
    with pytest.raises(EstimatorError, match=file):
        read_log(bag, raven_schema())


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


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"x", "y", "z"]', '"x", "y", "w"]', "no feature w"),
        ("tool_mm", "tool_m", "tool_m"),
        ('robot = "two-link"', "", "'robot'"),
        ("position_to_mm = 1000.0", "position_to_mm = 0", "'position_to_mm'"),
        ("scale = 0.017453292519943295", "scale = nan", "'joints.0.scale'"),
        ("scale = 0.017453292519943295", "scale = 0", "0 is no factor between units"),
        ("alpha_deg = 0", "alpha_deg = inf", "'joints.0.alpha_deg'"),
        ("tool_mm", "coupled = [2]\ntool_mm", "coupled names joint 2; there are 2, from 0 on"),
    ],
)
def test_a_wrong_robot_file_is_explained(old: str, new: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(GENERIC.replace(old, new, 1))
    with pytest.raises(EstimatorError, match=reason):
        find_schema(str(path))


def test_a_state_of_older_software_is_read_as_far_as_it_goes(
    shared: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What a model of all features needs is refused; what registers and pairs is there."""
    from measure_learning.api.pairing import open_logs

    bag = shared / "inputs" / "raven_state_without_dac" / "raven.bag"
    (log,) = open_logs([""], [bag], raven_schema(), None)
    assert "lacks dac_val, jac_vel, jac_f: the other 98 of 118 features" in caplog.text
    assert log.schema.names == tuple(
        name for name in raven_schema().names if not name.startswith(("dac_val", "jac_"))
    )
    assert log.complete.all()
    assert len(log.times_s) == 900
    assert log.states_at(np.array([3, 5])).shape == (2, 98)
    assert log.schema.joint_positions(log.states_at(np.arange(900))).std(axis=0).max() > 0.01
    with pytest.raises(EstimatorError, match="no field 'dac_val'"):
        read_log(bag, raven_schema())

"""Logs that ordinary robots write, by their own writers, are read to the same table."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure_learning.core.files import read_labelled
from measure_learning.robots import LogFile, find_schema, read_log, write_log
from tests import bags

TIMES = 100.0 + np.arange(40) / 100
WAVE = 0.3 * np.sin(np.arange(40)[:, None] / 7 + np.arange(7)) - 0.4
UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
PSM = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


def joints_of(robot: str) -> np.ndarray:
    chain = find_schema(robot).chain
    q = WAVE[:, : chain.size].copy()
    q[:, [joint.prismatic for joint in chain.joints]] += 0.6  # metres
    return q


OWN_MM = np.array([0.3, -0.4, 0.2])  # from the published kinematics to a controller's own


def tips_of(robot: str) -> np.ndarray:
    schema = find_schema(robot)
    slides = [joint.prismatic for joint in schema.chain.joints]
    return schema.chain.tip_mm(joints_of(robot) * np.where(slides, 1000.0, 1.0))


def write_text(path: Path, mark: str, columns: dict[str, np.ndarray]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=mark)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def rtde(path: Path) -> None:
    """As `record.py` of Universal Robots' own client writes it."""
    q, tip = joints_of("ur5e"), (tips_of("ur5e") + OWN_MM) / 1000
    columns = {"timestamp": TIMES}
    columns |= {f"actual_q_{i}": q[:, i] for i in range(6)}
    columns |= {f"actual_TCP_pose_{i}": tip[:, i] for i in range(3)}
    write_text(path, " ", columns | {f"actual_TCP_pose_{i}": TIMES for i in range(3, 6)})


def franka(path: Path) -> None:
    q, tip = joints_of("franka"), (tips_of("franka") + OWN_MM) / 1000
    names = ["time", *(f"q[{i}]" for i in range(7)), *(f"O_T_EE[{i}]" for i in range(16))]
    pose = np.zeros((40, 16))
    pose[:, 12:15] = tip
    rows = np.column_stack([TIMES, q, pose])
    np.savetxt(path, rows, "%.17g", delimiter=", ", header=", ".join(names), comments="")


def dvrk(path: Path) -> None:
    """As `rostopic echo -p /PSM1/setpoint_js` writes it: nanoseconds, no position."""
    q = joints_of("dvrk-psm")
    stamps = np.round(TIMES * 1e9).astype(np.int64)
    columns = {"%time": stamps + 5_000_000, "field.header.seq": np.arange(40)}
    columns |= {"field.header.stamp": stamps}
    write_text(path, ",", columns | {f"field.position{i}": q[:, i] for i in range(6)})


def plain(path: Path) -> None:
    """A spreadsheet's: semicolons, decimal commas, UTF-16, milliseconds, degrees."""
    rows = np.column_stack([TIMES * 1e3, np.degrees(joints_of("xarm6"))])
    lines = ["time_ms;" + ";".join(f"joint_{i}_deg" for i in range(1, 7))]
    lines += [";".join(f"{v:.12f}".replace(".", ",") for v in row) for row in rows]
    path.write_text("\r\n".join(lines) + "\r\n", encoding="utf-16")


class Bag(bags.Bag):
    """A bag of joints and tips."""

    def __init__(self, path: Path) -> None:
        tree = "geometry_msgs/TransformStamped[] transforms"
        known = {"tf2_msgs/msg/TFMessage": tree} if path.suffix == ".bag" else {}
        super().__init__(path, definitions=known)

    def vector(self, kind: str, xyz: Any) -> Any:
        return self.make(f"geometry_msgs/{kind}", **dict(zip("xyz", xyz, strict=True)))

    def turn(self) -> Any:
        return self.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)

    def pose(self, topic: str, time_s: float, xyz_m: Any) -> None:
        place = self.make(
            "geometry_msgs/Pose", position=self.vector("Point", xyz_m), orientation=self.turn()
        )
        header = self.header(time_s)
        self.send(topic, "geometry_msgs/PoseStamped", time_s, header=header, pose=place)

    def frame(self, topic: str, time_s: float, parent: str, child: str, xyz_m: Any) -> None:
        body = self.make(
            "geometry_msgs/Transform", translation=self.vector("Vector3", xyz_m),
            rotation=self.turn(),
        )  # fmt: skip
        stamped = self.make(
            "geometry_msgs/TransformStamped", header=self.header(time_s, parent),
            child_frame_id=child, transform=body,
        )  # fmt: skip
        self.send(topic, "tf2_msgs/TFMessage", time_s, transforms=[stamped])


def crtk(path: Path) -> None:
    """A dVRK's: commanded and measured joints, the measured pose; another arm's jaw."""
    q, tip = joints_of("dvrk-psm"), (tips_of("dvrk-psm") + OWN_MM) / 1000
    with Bag(path) as bag:
        for time, joints, place in zip(TIMES, q, tip, strict=True):
            bag.joints("/PSM1/measured_js", time, PSM, joints + 0.5)
            bag.joints("/PSM1/setpoint_js", time, PSM, joints)
            bag.pose("/PSM1/setpoint_cp", time, place)
            bag.pose("/PSM1/measured_cp", time, place + 0.5)
            bag.joints("/PSM1/jaw/setpoint_js", time, ["jaw"], [0.1])


def joint_states(path: Path) -> None:
    """A UR's driver: names in the alphabet's order, a gripper beside them, the tip in /tf."""
    q, tip = joints_of("ur5e"), (tips_of("ur5e") + OWN_MM) / 1000
    order = np.argsort(UR)
    with Bag(path) as bag:
        bag.frame("/tf_static", TIMES[0], "world", "base", [9.0, 9.0, 9.0])
        bag.frame("/tf_static", TIMES[0], "wrist", "tool0", [0.0, 0.0, 0.1])
        for time, joints, place in zip(TIMES, q, tip, strict=True):
            bag.joints("/joint_states", time, ["finger_joint"], [0.01])
            bag.joints("/joint_states", time, [f"{UR[i]}_joint" for i in order], joints[order])
            bag.frame("/tf", time, "base", "wrist", place - [0.0, 0.0, 0.1])


def iiwa(path: Path) -> None:
    """Joints only: the tip is computed."""
    with Bag(path) as bag:
        for time, joints in zip(TIMES, joints_of("kuka-iiwa"), strict=True):
            bag.joints("/joint_states", time, [f"lbr_A{i}" for i in range(1, 8)], joints)


FORMATS: list[tuple[str, str, Callable[[Path], None]]] = [
    ("ros1.bag", "dvrk-psm", crtk),
    ("tree.bag", "ur5e", joint_states),
    ("ros2_folder", "ur5e", joint_states),
    ("log.mcap", "kuka-iiwa", iiwa),
    ("rtde.csv", "ur5e", rtde),
    ("franka.txt", "franka", franka),
    ("psm1.csv", "dvrk-psm", dvrk),
    ("table.csv", "xarm6", plain),
]


@pytest.mark.parametrize(("name", "robot", "write"), FORMATS, ids=[name for name, _, _ in FORMATS])
def test_seven_formats_are_one_table(
    name: str, robot: str, write: Callable[[Path], None], tmp_path: Path
) -> None:
    write(tmp_path / name)
    log = LogFile(tmp_path / name, find_schema(robot))
    np.testing.assert_allclose(log.times_s, TIMES, atol=1e-6)
    states = log.states_at(np.arange(40))
    tips = tips_of(robot) + (0.0 if write in (dvrk, plain, iiwa) else OWN_MM)
    assert log.computed == (write in (dvrk, plain, iiwa))
    np.testing.assert_allclose(states, np.hstack([joints_of(robot), tips]), atol=2e-6)
    np.testing.assert_allclose(log.reported_mm, tips, atol=2e-6)


def test_a_named_topic_and_a_tip_that_is_seldom_seen(tmp_path: Path) -> None:
    with Bag(tmp_path / "two.mcap") as bag:
        for i, time in enumerate(TIMES):
            for arm in ("/PSM1", "/PSM2"):
                bag.joints(f"{arm}/measured_js", time, PSM, joints_of("dvrk-psm")[i])
            if i in (2, 12, 39):  # the last two are too far apart in time
                bag.pose("/PSM2/measured_cp", time, [0.001 * i, 0.0, 0.0])
    schema = find_schema("dvrk-psm")
    with pytest.raises(EstimatorError, match="may be those of /PSM1/measured_js, /PSM2/measured_"):
        read_log(tmp_path / "two.mcap", schema)
    x = read_log(tmp_path / "two.mcap", schema, topic="/PSM2/measured_js").states[:, 6]
    np.testing.assert_allclose(x[2:13], np.arange(2, 13), atol=1e-6)
    assert np.isnan(x[[0, 1, 20, 38]]).all()
    assert x[39] == pytest.approx(39)


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        ("dvrk-psm", r"dvrk-psm \(q1_cmd, .*/joint_states has finger_joint, .*wrist_3_joint: name"),
        ("raven", r"0 topics match raven_state; it has /joint_states \(sensor_msgs/JointState\), "),
    ],
)
def test_what_a_bag_holds_is_said(robot: str, words: str, tmp_path: Path) -> None:
    joint_states(tmp_path / "ur.mcap")
    with pytest.raises(EstimatorError, match=words):
        read_log(tmp_path / "ur.mcap", find_schema(robot))


def test_what_a_file_is_counts_and_not_its_name(tmp_path: Path) -> None:
    schema = find_schema("ur5e")
    rtde(tmp_path / "log.txt")
    log = read_log(tmp_path / "log.txt", schema)
    assert len(log.times_s) == 40
    write_log(tmp_path / "log.dat", log)
    assert len(read_log(tmp_path / "log.dat", schema).times_s) == 40
    joint_states(tmp_path / "made.bag")
    (tmp_path / "made.bag").rename(tmp_path / "log.csv")
    rtde(tmp_path / "text.bag")
    (tmp_path / "empty_ros2").mkdir()
    (tmp_path / "junk.parquet").write_bytes(b"nothing")
    for name, words in (
        ("none.parquet", "no such robot log"),
        ("junk.parquet", "cannot be read"),
        ("log.csv", "is a bag: rename it to log.bag"),
        ("text.bag", "cannot be read as a bag: it is text that begins 'timestamp actual_q_0'"),
        ("empty_ros2", "cannot be read as a bag"),
    ):
        with pytest.raises(EstimatorError, match=f"{name}: {words}"):
            read_log(tmp_path / name, schema)


@pytest.mark.parametrize(
    ("robot", "columns", "words"),
    [
        # Seven joints are not the first six of another robot.
        ("ur5e", [*(f"q{i}" for i in range(1, 8))], r"lacks 9 of 9.*--robot franka or kuka-iiwa"),
        ("raven", [f"q{i}_cmd" for i in range(1, 7)], r"lacks 118 .* fit --robot dvrk-psm$"),
        ("ur5e", [f"joint_{i}" for i in range(1, 6)], r"lacks 9 of 9 .*it has time_s, joint_1, "),
    ],
)
def test_columns_of_another_robot(
    robot: str, columns: list[str], words: str, tmp_path: Path
) -> None:
    table = {"time_s": TIMES} | dict.fromkeys(columns, WAVE[:, 0])
    write_text(tmp_path / "log.csv", ",", table)
    with pytest.raises(EstimatorError, match=words):
        read_log(tmp_path / "log.csv", find_schema(robot))


def test_labelled_data_of_another_robot_names_it(tmp_path: Path) -> None:
    names = ("run", "t_s", "ex", "ey", "ez", *(f"q{i}_cmd" for i in range(1, 7)))
    write_text(tmp_path / "data.csv", ",", dict.fromkeys(names, TIMES))
    with pytest.raises(EstimatorError, match="its columns fit --robot dvrk-psm"):
        read_labelled(tmp_path / "data.csv", find_schema("raven"))


def test_degrees_are_not_read_as_radians(tmp_path: Path) -> None:
    q = np.degrees(joints_of("ur5e"))
    write_text(tmp_path / "log.csv", ",", {"t": TIMES} | {f"q{i + 1}": q[:, i] for i in range(6)})
    with pytest.raises(EstimatorError, match=r"joint 'q1' seems to turn \d+ times round.*degrees"):
        read_log(tmp_path / "log.csv", find_schema("ur5e"))


@pytest.mark.parametrize(
    ("name", "factor", "read"),
    [
        ("time", 1.0, True),  # 100 Hz: steps of 0.01 are seconds
        ("timestamp", 1e3, True),  # of 10, milliseconds
        ("time [us]", 1e6, True),
        ("header.stamp", 1e9, True),
        ("t", 1e1, False),  # of 0.1, either
        ("clock", 1.0, False),
    ],
)
def test_the_unit_of_the_time(name: str, factor: float, read: bool, tmp_path: Path) -> None:
    q = joints_of("ur5e")
    path, robot = tmp_path / "log.csv", tmp_path / "robot.toml"
    columns = {f"q{i + 1}": q[:, i] for i in range(6)}
    write_text(path, ",", {name: (TIMES - 99.0) * factor} | columns)
    schema = find_schema("ur5e")
    if not read:
        with pytest.raises(EstimatorError, match=r"\[log\] time"):
            read_log(path, schema)
        unit = {1.0: "s", 10.0: "ms"}[factor]
        robot.write_text(f'like = "ur5e"\n[log]\ntime = "{name}"\ntime_unit = "{unit}"\n')
        scale = {"s": 1.0, "ms": 1e-3}[unit] * factor
        np.testing.assert_allclose(
            read_log(path, find_schema(str(robot))).times_s, scale * (TIMES - 99)
        )
    else:
        np.testing.assert_allclose(read_log(path, schema).times_s, TIMES - 99.0, atol=1e-6)

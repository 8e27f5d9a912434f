"""Logs whose headings or messages hold the joints in other ways than a robot's own programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure_learning.robots import LogFile, find_schema, read_log
from measure_learning.robots.headings import ToolHeadings
from measure_learning.robots.tool_poses import read_tool_poses
from tests.learning.robots.test_known_robots import write_urdf
from tests.learning.robots.test_log_formats import TIMES, UR, Bag, joints_of, tips_of, write_text

NAMES = [f"{name}_joint" for name in UR]


def test_a_prefix_that_makes_all_joints_fit_is_taken(tmp_path: Path) -> None:
    with Bag(tmp_path / "left.mcap") as bag:
        for t, q in zip(TIMES, joints_of("ur5e"), strict=True):
            bag.joints("/joint_states", t, [f"left_{name}" for name in NAMES], q)
    found = read_log(tmp_path / "left.mcap", find_schema("ur5e"))
    np.testing.assert_allclose(found.states[:, :6], joints_of("ur5e"))


def test_two_prefixes_are_asked_about(tmp_path: Path) -> None:
    with Bag(tmp_path / "two.mcap") as bag:
        for t, q in zip(TIMES, joints_of("ur5e"), strict=True):
            names = [f"{side}_{name}" for side in ("left", "right") for name in NAMES]
            bag.joints("/joint_states", t, names, [*q, *q])
    words = r"as left_shoulder_pan_joint \.\.\. and as right_shoulder_pan_joint .*\[log\] joints = "
    with pytest.raises(EstimatorError, match=words):
        read_log(tmp_path / "two.mcap", find_schema("ur5e"))


def test_parts_of_several_publishers_are_joined(tmp_path: Path) -> None:
    q = joints_of("ur5e")
    with Bag(tmp_path / "parts.mcap") as bag:
        for k, t in enumerate(TIMES):
            bag.joints("/joint_states", t, NAMES[:3], q[k, :3])
            late = q[k, 3:] + 0.002 / 0.01 * (q[min(k + 1, 39), 3:] - q[k, 3:])
            bag.joints("/joint_states", t + 0.002, NAMES[3:], late)
            bag.joints("/joint_states", t + 0.001, ["finger"], [0.1])
    found = read_log(tmp_path / "parts.mcap", find_schema("ur5e"))
    assert len(found.times_s) == 40
    assert np.abs(found.states[1:-1, :6] - q[1:-1]).max() < 2e-3


def test_names_inside_headings_in_any_order(tmp_path: Path) -> None:
    q = joints_of("ur5e")
    columns = {"__time": TIMES}
    for k in np.argsort(NAMES):
        columns[f"/joint_states/{NAMES[k]}/position"] = q[:, k]
        columns[f"/joint_states/{NAMES[k]}/velocity"] = 100 + q[:, k]
    write_text(tmp_path / "log.csv", ",", columns)
    found = read_log(tmp_path / "log.csv", find_schema("ur5e"))
    np.testing.assert_allclose(found.states[:, :6], q)


def test_positions_by_place_are_no_order_of_joints(tmp_path: Path) -> None:
    q = joints_of("ur5e")[:, np.argsort(NAMES)]
    write_text(
        tmp_path / "log.csv", ",", {"time": TIMES} | {f"position_{k}": q[:, k] for k in range(6)}
    )
    with pytest.raises(EstimatorError, match=r"by place, and a message's order need not") as caught:
        read_log(tmp_path / "log.csv", find_schema("ur5e"))
    assert "dvrk" not in str(caught.value)


def test_a_rail_in_mm_is_named_with_the_cure(tmp_path: Path) -> None:
    urdf = tmp_path / "arm.urdf"
    write_urdf(urdf, "ur5e", ('joint_0" type="revolute"', 'joint_0" type="prismatic"'))
    q = joints_of("ur5e") * [200, 1, 1, 1, 1, 1]
    columns = {"time_s": TIMES} | {f"joint_{k}": q[:, k] for k in range(6)}
    write_text(tmp_path / "log.csv", ",", columns)
    with pytest.raises(EstimatorError, match=r"'joint_0' seems to slide \d+ m: .*mm\? ") as caught:
        read_log(tmp_path / "log.csv", find_schema(str(urdf)))
    cure = str(caught.value).partition("robot.toml: ")[2]
    file = tmp_path / "robot.toml"
    file.write_text(f'robot = "rail"\nurdf = "arm.urdf"\n{cure}\n')
    found = read_log(tmp_path / "log.csv", find_schema(str(file)))
    np.testing.assert_allclose(found.schema.joint_positions(found.states), q)


def test_rtde_columns_with_ones_own_urdf(tmp_path: Path) -> None:
    write_urdf(tmp_path / "arm.urdf", "ur5e")
    q = joints_of("ur5e")
    columns = {"timestamp": TIMES} | {f"actual_q_{k}": q[:, k] for k in range(6)}
    write_text(tmp_path / "log.csv", ",", columns)
    found = read_log(tmp_path / "log.csv", find_schema(str(tmp_path / "arm.urdf")))
    np.testing.assert_allclose(found.schema.joint_positions(found.states), q)


def test_a_joint_that_mimics_another_one_follows_it(tmp_path: Path) -> None:
    """A parallelogram: the fourth joint turns back by what the second one turns, and 0.1 rad."""
    mimic = '<axis xyz="0 0 1"/><mimic joint="joint_1" multiplier="-1" offset="0.1"/></joint>'
    write_urdf(tmp_path / "plain.urdf", "ur5e")
    text = (tmp_path / "plain.urdf").read_text().split('<joint name="joint_3"')
    changed = text[1].replace('<axis xyz="0 0 1"/></joint>', mimic, 1)
    (tmp_path / "arm.urdf").write_text(f'{text[0]}<joint name="joint_3"{changed}')
    schema, plain = (find_schema(str(tmp_path / f"{n}.urdf")) for n in ("arm", "plain"))
    assert "joint_3" not in schema.names
    assert schema.chain is not None
    q = joints_of("ur5e")
    free = {f"joint_{k}": q[:, k] for k in (0, 1, 2, 4, 5)}
    write_text(tmp_path / "log.csv", ",", {"time_s": TIMES} | free)
    found = read_log(tmp_path / "log.csv", schema)
    q[:, 3] = 0.1 - q[:, 1]
    assert np.abs(found.reported_mm - plain.chain.tip_mm(q)).max() < 1e-6


def test_xacro_is_named_with_the_cure(tmp_path: Path) -> None:
    with pytest.raises(
        EstimatorError, match=r"xacro must be expanded first: `xacro arm.urdf.xacro"
    ):
        find_schema("arm.urdf.xacro")
    file = tmp_path / "arm.urdf"
    file.write_text('<robot xmlns:xacro="x"><xacro:property name="t" value="1"/></robot>')
    with pytest.raises(EstimatorError, match="holds xacro that is not expanded"):
        find_schema(str(file))


def written(how: str, poses: RigidTransform) -> dict[str, np.ndarray]:
    turns, place = Rotation.from_matrix(poses.rotation), poses.translation
    if how == "ur":
        values = np.column_stack([place / 1e3, turns.as_rotvec()])
        return {f"actual_TCP_pose_{k}": values[:, k] for k in range(6)}
    if how == "kuka":
        values = np.column_stack([place, turns.as_euler("ZYX", degrees=True)])
        return dict(zip("XYZABC", values.T, strict=True))
    values = np.column_stack([place / 1e3, turns.as_quat()])
    return dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values.T, strict=True))


@pytest.mark.parametrize("how", ["ur", "kuka", "ros"])
def test_a_tools_poses_are_read_as_they_are_written(how: str, tmp_path: Path) -> None:
    chain = find_schema("ur5e").chain
    poses = chain.pose(3 * joints_of("ur5e"))
    columns = {"time_s": TIMES} | written(how, poses)
    write_text(tmp_path / "log.csv", ",", columns)
    assert ToolHeadings.of(list(columns))
    log = read_tool_poses(tmp_path / "log.csv", find_schema("ur5e"))[0][1]
    found = log.schema.chain.pose(log.schema.joint_positions(log.states))
    assert np.abs(found.difference(poses)).max() < 1e-5
    assert np.abs(log.reported_mm - poses.translation).max() < 1e-5


def test_a_table_of_joints_is_none_of_tool_poses() -> None:
    assert not ToolHeadings.of(["time_s", "x_mm", "y_mm", "z_mm", *NAMES])


def test_a_bag_that_was_cut_off_is_read_and_named(tmp_path: Path, caplog) -> None:
    for ending in ("mcap", "db3"):
        path = tmp_path / (f"log.{ending}" if ending == "mcap" else "bag")
        with Bag(path) as bag:
            for t, q in zip(TIMES, joints_of("ur5e"), strict=True):
                bag.joints("/joint_states", t, NAMES, q)
    inside = next((tmp_path / "log.mcap").glob("*.mcap"), tmp_path / "log.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(inside.read_bytes()[: inside.stat().st_size // 2])
    some = LogFile(cut, find_schema("ur5e"))
    some.states_at(np.array([0, 1]))
    assert caplog.text.count("its end is missing (the recording was cut off)") == 1
    assert 0 < len(some.times_s) <= len(TIMES)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    found = read_log(tmp_path / "bag", find_schema("ur5e"))
    np.testing.assert_allclose(found.reported_mm, tips_of("ur5e"))

"""Built-in robots and robot files: kinematics against other published ones, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots import SerialChain, StateSchema
from measure_learning.robots import find_schema, robot_names

QUARTER = np.pi / 2


def chain_of(name: str) -> SerialChain:
    chain = find_schema(name).chain
    assert chain is not None
    return chain


@pytest.mark.parametrize(
    ("name", "degrees", "tip_mm"),
    [
        # UR's own calculator at zero; the ready pose of franka_ros (flange, 103.4 mm above the
        # hand's centre); UFACTORY's home pose; KUKA's height of the upright arm.
        ("ur5e", [0] * 6, [-817.2, -232.9, 62.8]),
        ("ur10e", [0] * 6, [-1184.25, -290.7, 60.85]),
        ("franka", [0, -45, 0, -135, 0, 90, 45], [306.9, 0.0, 590.3]),
        ("xarm6", [0] * 6, [207.0, 0.0, 112.0]),
        ("kuka-iiwa", [0] * 7, [0.0, 0.0, 1266.0]),
    ],
)
def test_published_poses(name: str, degrees: list[float], tip_mm: list[float]) -> None:
    tip = chain_of(name).tip_mm(np.deg2rad(degrees))
    np.testing.assert_allclose(tip, tip_mm, atol=0.06)


# Origins of the joints (m, roll pitch yaw) and of the flange in the makers' own URDFs: another
# description than the tables of Denavit and Hartenberg.
ORIGINS = {
    "ur5e": [
        ((0, 0, 0.1625), (0, 0, 0)),
        ((0, 0, 0), (QUARTER, 0, 0)),
        ((-0.425, 0, 0), (0, 0, 0)),
        ((-0.3922, 0, 0.1333), (0, 0, 0)),
        ((0, -0.0997, 0), (QUARTER, 0, 0)),
        ((0, 0.0996, 0), (QUARTER, np.pi, np.pi)),
        ((0, 0, 0), (0, 0, 0)),
    ],
    "franka": [
        ((0, 0, 0.333), (0, 0, 0)),
        ((0, 0, 0), (-QUARTER, 0, 0)),
        ((0, -0.316, 0), (QUARTER, 0, 0)),
        ((0.0825, 0, 0), (QUARTER, 0, 0)),
        ((-0.0825, 0.384, 0), (-QUARTER, 0, 0)),
        ((0, 0, 0), (QUARTER, 0, 0)),
        ((0.088, 0, 0), (QUARTER, 0, 0)),
        ((0, 0, 0.107), (0, 0, 0)),
    ],
    "kuka-iiwa": [
        ((0, 0, 0.15), (0, 0, 0)),
        ((0, 0, 0.19), (QUARTER, 0, np.pi)),
        ((0, 0.21, 0), (QUARTER, 0, np.pi)),
        ((0, 0, 0.19), (QUARTER, 0, 0)),
        ((0, 0.21, 0), (-QUARTER, np.pi, 0)),
        ((0, 0.06070, 0.19), (QUARTER, 0, 0)),
        ((0, 0.081, 0.06070), (-QUARTER, np.pi, 0)),
        ((0, 0, 0.045), (0, 0, 0)),
    ],
}


def write_urdf(path: Path, robot: str, change: tuple[str, str] = ("", "")) -> None:
    joints = [
        f'<joint name="joint_{i}" type="{kind}">'
        f'<parent link="link_{i}"/><child link="link_{i + 1}"/>'
        f'<origin xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/>'
        '<axis xyz="0 0 1"/></joint>'
        for i, (xyz, rpy) in enumerate(ORIGINS[robot])
        for kind in ["fixed" if i == len(ORIGINS[robot]) - 1 else "revolute"]
    ]
    path.write_text(f'<robot name="r">{"".join(joints)}</robot>'.replace(*change))


@pytest.mark.parametrize("robot", ORIGINS)
def test_tables_agree_with_the_makers_urdf(robot: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    write_urdf(path, robot)
    urdf, table = find_schema(str(path)), chain_of(robot)
    assert urdf.names == (*(f"joint_{i}" for i in range(table.size)), "x_mm", "y_mm", "z_mm")
    q = np.random.default_rng(1).uniform(-2, 2, (30, table.size))
    apart = urdf.chain.pose(q).difference(table.pose(q))
    assert np.abs(apart[:, :3]).max() < 1e-6
    turns = RigidTransform.from_rotvec(apart[:, 3:]).rotvec
    np.testing.assert_allclose(turns, np.broadcast_to(turns[0], turns.shape), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('type="revolute"', 'type="planar"'), "joint 'joint_0' is planar"),
        (
            ('<axis xyz="0 0 1"/>', '<mimic joint="joint_1" multiplier="x"/>'),
            'mimic multiplier="x" is no number',
        ),
        (('xyz="0 0 1"', 'xyz="0 0 ${z}"'), "xacro that is not expanded: run `xacro"),
        (('child link="link_3"', 'child link="hand"'), "name the link of the tip.*hand, link_7"),
        (("</robot>", ""), "no URDF: .*xacro must be expanded"),
        (('xyz="0 0 1"', 'xyz="0 0 up"'), 'xyz="0 0 up" is not three numbers'),
        (('xyz="0 0 1"', 'xyz="0 0 0"'), "'joint_0' has an axis of length 0"),
    ],
)
def test_a_urdf_that_is_no_chain(change: tuple[str, str], message: str, tmp_path: Path) -> None:
    write_urdf(tmp_path / "arm.urdf", "ur5e", change)
    with pytest.raises(EstimatorError, match=message):
        find_schema(str(tmp_path / "arm.urdf"))


def test_a_part_of_a_urdf_with_a_tool(tmp_path: Path) -> None:
    write_urdf(tmp_path / "arm.urdf", "ur5e")
    robot = tmp_path / "robot.toml"
    text = (
        'robot = "part"\nurdf = "arm.urdf"\nbase = "link_1"\ntip = "link_3"\ntool_mm = [7, 0, 0]\n'
    )
    robot.write_text(text)
    schema = find_schema(str(robot))
    assert schema.names[:2] == ("joint_1", "joint_2")
    np.testing.assert_allclose(schema.chain.tip_mm([0.0, 0.0]), [-418.0, 0.0, 0.0], atol=1e-9)
    robot.write_text(text.replace('"link_1"', '"hand"'))
    with pytest.raises(EstimatorError, match="no chain leads from link 'hand' to 'link_3'"):
        find_schema(str(robot))


@pytest.mark.parametrize("name", robot_names())
def test_a_schema_survives_a_file(name: str) -> None:
    schema = find_schema(name)
    again = StateSchema.from_dict(schema.to_dict())
    assert (again.log, again.groups, again.names) == (schema.log, schema.groups, schema.names)


def test_a_robot_like_a_known_one(tmp_path: Path) -> None:
    robot = tmp_path / "robot.toml"
    robot.write_text('like = "ur5e"\nrobot = "ours"\ntool_mm = [0, 0, 100]\n')
    ours = find_schema(str(robot))
    assert ours.robot == "ours"
    q = np.random.default_rng(2).uniform(-2, 2, 6)
    tip = chain_of("ur5e").pose(q).apply([0.0, 0.0, 100.0])
    np.testing.assert_allclose(ours.chain.tip_mm(q), tip, atol=1e-9)
    robot.write_text('like = "ur6"\n')
    with pytest.raises(EstimatorError, match="like = 'ur6' is no robot; there is dvrk-psm, franka"):
        find_schema(str(robot))


def test_the_files_of_the_documentation(tmp_path: Path) -> None:
    page = Path(__file__).parents[3] / "docs" / "how_to" / "read_a_robots_log.md"
    texts = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    for text, names in zip(texts, (9, 5), strict=True):
        (tmp_path / "robot.toml").write_text(text)
        schema = find_schema(str(tmp_path / "robot.toml"))
        assert len(schema.names) == names
    np.testing.assert_allclose(schema.chain.tip_mm([QUARTER, -QUARTER]), [50, 100, 0], atol=1e-9)


TABLE = """
robot = "arm"
joints = [
  {feature = "a", alpha_deg = 0, d_mm = 100},
  {feature = "b", alpha_deg = 90, a_mm = 200},
]
"""


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("alpha_deg = 90", "alpha_deg = 1.5708", "angle of 1.5708 deg, which is a right angle"),
        ("alpha_deg = 90", "alpha_deg = 900", "'joints.1.alpha_deg': .*less than or equal to 360"),
        ("alpha_deg = 90, ", "", "joint 'b' has no alpha_deg: give it for all joints, or none"),
        ("d_mm = 100},\n  ", "d_mm = 0.1},\n  ", ""),
        ("= 200", "= 0.2", ""),
        ("= 200", "= 20000", "'joints.1.a_mm'"),
        ("alpha_deg = 0, ", "scale = 1000, alpha_deg = 0, ", "scale 1000 of joint 'a' is not that"),
        ("robot", 'position = ["x", "y", "z"]\nrobot', "no feature x, y, z; its 2 features"),
    ],
)
def test_nonsense_in_a_table_of_links(old: str, new: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(TABLE)
    assert find_schema(str(path)).names == ("a", "b", "x_mm", "y_mm", "z_mm")
    text = TABLE.replace(old, new, 1)
    if not reason:  # metres in both places
        text = text.replace("= 100", "= 0.1").replace("= 200", "= 0.2")
        reason = r"its links are 0\.\d+ mm long together, no robot's: are they in mm"
    path.write_text(text)
    with pytest.raises(EstimatorError, match=reason):
        find_schema(str(path))

"""Truths as SLAM tools, ROS and motion capture leave them; the units of their times."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from measure.errors import RunError, SessionError
from measure.geometry import RigidTransform
from measure.session import read_trajectory
from tests.bags import Bag

TIMES = np.arange(200) / 100
PLACES_M = np.stack([0.02 * np.sin(TIMES), 0.03 * np.cos(3 * TIMES), 0.2 + 0.01 * TIMES], axis=1)
TURNS = Rotation.from_rotvec(np.stack([0.1 * TIMES, 0.2 * np.sin(TIMES), 0.3 + 0 * TIMES], axis=1))
WXYZ = TURNS.as_quat(scalar_first=True)
EUROC = "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
TRUE = RigidTransform(TURNS.as_matrix(), 1000 * PLACES_M)


def write(path, header, *columns):
    rows = [",".join(str(cell) for cell in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def in_ns(times_s):
    return [round(1e9 * time_s) for time_s in times_s]


def agrees(found):
    np.testing.assert_allclose(found.times_s, TIMES, atol=1e-6)
    assert np.abs(found.world_from_body.difference(TRUE)).max() < 1e-6


@pytest.mark.parametrize(
    "header",
    [
        f"#timestamp [ns],{EUROC},v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]",
        f"#timestamp, {EUROC.replace(',', ', ')}, b_w_x, b_w_y, b_w_z",
        "time_ns,tx_m,ty_m,tz_m,qw,qx,qy,qz,vx,vy,vz",
    ],
)
def test_tables_are_read_by_their_headings(tmp_path, header):
    path = write(tmp_path / "t.csv", header, in_ns(TIMES), *PLACES_M.T, *WXYZ.T, *PLACES_M.T)
    agrees(read_trajectory(path, during_s=(0.0, 1.5)))


@pytest.mark.parametrize(
    ("place", "turn"),
    [
        ("field.pose.position", "field.pose.orientation"),
        ("field.pose.pose.position", "field.pose.pose.orientation"),
        ("field.transform.translation", "field.transform.rotation"),
    ],
)
def test_what_rostopic_echo_writes_is_read(tmp_path, place, turn):
    names = [f"{place}.{a}" for a in "xyz"] + [f"{turn}.{a}" for a in "xyzw"]
    twist = [f"field.twist.twist.linear.{a}" for a in "xyz"]
    header = ",".join(["%time", "field.header.seq", "field.header.stamp", *names, *twist])
    ns, xyzw = np.array(in_ns(TIMES)), np.roll(WXYZ, -1, axis=1)
    path = write(
        tmp_path / "t.csv", header, ns + 5_000_000, range(200), ns, *PLACES_M.T, *xyzw.T,
        *PLACES_M.T,
    )  # fmt: skip
    agrees(read_trajectory(path))


def parts(bag, row, point, of):
    place = bag.make(f"geometry_msgs/{point}", **dict(zip("xyz", PLACES_M[row], strict=True)))
    turn = bag.make("geometry_msgs/Quaternion", **dict(zip("wxyz", WXYZ[row], strict=True)))
    names = ("position", "orientation") if of == "Pose" else ("translation", "rotation")
    return bag.make(f"geometry_msgs/{of}", **dict(zip(names, (place, turn), strict=True)))


def send(bag, kind, row):
    time_s = TIMES[row]
    head, spread = {"header": bag.header(time_s, "map")}, np.zeros(36)
    if "Transform" in kind or kind == "tf2_msgs/TFMessage":
        moved = bag.make(
            "geometry_msgs/TransformStamped",
            **head, child_frame_id="tool", transform=parts(bag, row, "Vector3", "Transform"),
        )  # fmt: skip
        if kind == "tf2_msgs/TFMessage":
            bag.send("/tf", kind, time_s + 0.01, transforms=[moved])
        else:
            fields = {"child_frame_id": "tool", "transform": moved.transform}
            bag.send("/tool", kind, time_s + 0.01, **head, **fields)
        return
    pose = parts(bag, row, "Point", "Pose")
    if kind == "nav_msgs/Odometry":
        zero = bag.make("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
        still = bag.make("geometry_msgs/Twist", linear=zero, angular=zero)
        head["child_frame_id"] = "tool"
        head["twist"] = bag.make(
            "geometry_msgs/TwistWithCovariance", twist=still, covariance=spread
        )
    if kind != "geometry_msgs/PoseStamped":
        pose = bag.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=spread)
    bag.send("/tool", kind, time_s + 0.01, **head, pose=pose)


@pytest.mark.parametrize("ending", [".mcap", ".db3", ".bag"])
@pytest.mark.parametrize(
    "kind",
    [
        "geometry_msgs/PoseStamped",
        "geometry_msgs/PoseWithCovarianceStamped",
        "geometry_msgs/TransformStamped",
        "nav_msgs/Odometry",
        "tf2_msgs/TFMessage",
    ],
)
def test_poses_in_bags_are_read(tmp_path, kind, ending):
    if (kind, ending) == ("tf2_msgs/TFMessage", ".bag"):
        pytest.skip("rosbags knows no such type of ROS 1")
    path = tmp_path / f"truth{ending}"
    with Bag(path, ending) as bag:
        for row in range(len(TIMES)):
            send(bag, kind, row)
    agrees(read_trajectory(path))
    name = "tool" if kind == "tf2_msgs/TFMessage" else "/tool"
    agrees(read_trajectory(path, body=name))
    agrees(read_trajectory(f"{path}#{'tf' if name == 'tool' else 'tool'}"))
    with pytest.raises(SessionError, match=r"no topic /other of poses.*it has /t"):
        read_trajectory(f"{path}#/other")


@pytest.mark.parametrize("begin_s", [0.0, 1.7e9])
@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_the_unit_of_times_follows_from_what_they_are_compared_with(
    tmp_path, unit, factor, begin_s
):
    path = tmp_path / "truth.txt"
    xyzw = np.roll(WXYZ, -1, axis=1)
    stamps = [round((begin_s + t) * factor) for t in TIMES]
    rows = [" ".join(map(str, [t, *p, *q])) for t, p, q in zip(stamps, PLACES_M, xyzw, strict=True)]
    path.write_text("\n".join(rows))
    found = read_trajectory(path, during_s=(begin_s + 0.2, begin_s + 1.7))
    np.testing.assert_allclose(found.times_s, begin_s + TIMES, atol=1e-6)
    assert found.notes[0].endswith(f"they are taken for {unit}")


def test_slow_rows_and_true_seconds_stay(tmp_path):
    header = "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    path = write(tmp_path / "slow.csv", header, 5 * np.arange(200), *PLACES_M.T, *WXYZ.T)
    found = read_trajectory(path, during_s=(10.0, 800.0))
    assert found.times_s[-1] == 995
    assert found.notes == ()
    path = write(tmp_path / "fast.csv", header, TIMES, *PLACES_M.T, *WXYZ.T)
    assert read_trajectory(path, during_s=(1e6, 2e6)).notes == ()


def test_times_that_may_be_in_two_units_are_refused(tmp_path):
    header = "time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    path = write(tmp_path / "t.csv", header, 400 * np.arange(200), *PLACES_M.T, *WXYZ.T)
    with pytest.raises(RunError, match=r"apart: in (ms|us) or in (ms|us)\? Write seconds"):
        read_trajectory(path, RunError, during_s=(-10.0, -7.5))


def test_units_that_no_heading_tells_are_asked_for(tmp_path):
    header = "timestamp,px,py,pz,qw,qx,qy,qz"
    path = write(tmp_path / "t.csv", header, in_ns(TIMES), *PLACES_M.T, *WXYZ.T)
    with pytest.raises(SessionError, match="the header lacks x_mm, y_mm, z_mm"):
        read_trajectory(path)

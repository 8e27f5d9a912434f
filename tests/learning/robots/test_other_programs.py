"""Files that owners of robots have already: in, out, and in again the same to 1 um."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks.registration import stopped
from measure.cli import main
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots.chain import Joint, SerialChain, dh_link
from measure_learning.core.frames import read_frame
from measure_learning.robots import find_schema
from measure_learning.robots.links import with_link_errors
from measure_learning.robots.other_programs import (
    dvrk_with_offsets,
    read_samples,
    read_ur_calibration,
    ur_calibration_text,
)

UR5E = {
    "shoulder": {"z": 0.1625},
    "upper_arm": {"roll": np.pi / 2},
    "forearm": {"x": -0.425},
    "wrist_1": {"x": -0.3922, "z": 0.1333},
    "wrist_2": {"y": -0.0997, "roll": np.pi / 2},
    "wrist_3": {"y": 0.0996, "roll": np.pi / 2, "pitch": np.pi, "yaw": np.pi},
}
"""What the driver's own file of an uncalibrated UR5e says, m and rad."""


def ur_file(path: Path, **more: Any) -> Path:
    usual = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.0)
    links = {name: usual | values for name, values in UR5E.items()}
    path.write_text(yaml.safe_dump({"kinematics": links | {"hash": "calib_1"} | more}))
    return path


def test_the_calibration_of_a_ur_is_its_robot(tmp_path: Path) -> None:
    """Read it is the published arm; with measured links, written and read, the measured one."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-2.0, 2.0, (50, 6))
    schema = find_schema(str(ur_file(tmp_path / "calibration.yaml")))
    assert schema.robot == "calibration"
    known = find_schema("ur5e")
    assert schema.names == known.names
    assert schema.log == known.log
    assert schema.chain is not None
    assert np.abs(schema.chain.pose(q).difference(known.chain.pose(q))).max() < 1e-6
    measured = with_link_errors(schema.chain, rng.normal(0.0, 0.01, 36))
    (tmp_path / "again.yaml").write_text(ur_calibration_text(measured))
    (tmp_path / "arm.toml").write_text(
        'like = "ur10e"\nrobot = "mine"\ncalibration = "again.yaml"\ntool_mm = [0, 0, 50]\n'
    )
    chain = read_ur_calibration(tmp_path / "again.yaml")
    assert np.linalg.norm(chain.tip_mm(q) - measured.tip_mm(q), axis=1).max() < 1e-3
    assert np.linalg.norm(chain.tip_mm(q) - known.chain.tip_mm(q), axis=1).min() > 0.1
    mine = find_schema(str(tmp_path / "arm.toml"))
    assert mine.robot == "mine"
    longer = chain.pose(q) @ RigidTransform(np.eye(3), np.array([0.0, 0.0, 50.0]))
    np.testing.assert_allclose(mine.chain.tip_mm(q), longer.translation, atol=1e-6)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"wrist_3": 3}, "holds no table 'wrist_3'"),
        ({"forearm": {"x": 0.1}}, "y is None, no number"),
        ({"forearm": dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), "1")}, "x is '1', no"),
    ],
)
def test_another_calibration_is_refused(more: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(EstimatorError, match=said):
        find_schema(str(ur_file(tmp_path / "c.yaml", **more)))
    (tmp_path / "other.yaml").write_text("[1, 2")
    with pytest.raises(EstimatorError, match="no YAML"):
        find_schema(str(tmp_path / "other.yaml"))
    with pytest.raises(EstimatorError, match="six joints that turn about their z"):
        ur_calibration_text(find_schema("dvrk-psm").chain)
    arm = find_schema("ur5e").chain
    with pytest.raises(EstimatorError, match="leave the tool out"):
        ur_calibration_text(SerialChain(arm.joints, dh_link(0.0, 0.0, 0.0, 20.0)))


def _ros(pose: RigidTransform) -> dict[str, dict[str, float]]:
    w, *xyz = pose.quat_wxyz.tolist()
    return {
        "translation": dict(zip("xyz", (pose.translation / 1e3).tolist(), strict=True)),
        "rotation": dict(zip("xyzw", (*xyz, w), strict=True)),
    }


def samples(path: Path, *, eye_in_hand: bool, says: bool = True) -> tuple[Path, Any]:
    """Of a simulated arm, as easy_handeye2 or MoveIt (`.yaml`) stores them, and the arm."""
    stops, arm = stopped(4, 15)
    seen, robot = stops.poses.world_from_body, find_schema("ur5e").chain.pose(stops.states[:, :6])
    if eye_in_hand:
        seen = seen.inverse()
    if path.suffix == ".yaml":
        metres = np.diag([1e3, 1e3, 1e3, 1.0])
        pairs = [
            {
                "effector_wrt_world": (np.linalg.inv(metres) @ a.matrix @ metres).ravel().tolist(),
                "object_wrt_sensor": (np.linalg.inv(metres) @ b.matrix @ metres).ravel().tolist(),
            }
            for a, b in zip(_each(robot), _each(seen), strict=True)
        ]
        path.write_text(yaml.safe_dump(pairs))
        return path, arm
    kind = "eye_in_hand" if eye_in_hand else "eye_on_base"
    stored = robot if eye_in_hand else robot.inverse()
    pairs = [
        {"robot": _ros(a), "tracking": _ros(b)}
        for a, b in zip(_each(stored), _each(seen), strict=True)
    ]
    held = {"parameters": {"calibration_type": kind if says else ""}, "samples": pairs}
    path.write_text(yaml.safe_dump(held))
    return path, arm


def _each(poses: RigidTransform) -> list[RigidTransform]:
    both = zip(poses.rotation, poses.translation, strict=True)
    return [RigidTransform(turn, place) for turn, place in both]


@pytest.mark.parametrize("eye_in_hand", [False, True])
@pytest.mark.parametrize("name", ["mine.samples", "mine.yaml"])
def test_samples_of_other_programs_register(name: str, eye_in_hand: bool, tmp_path: Path) -> None:
    """As the same stops in a table do; what it says of the cameras is easy_handeye2's again."""
    path, arm = samples(tmp_path / name, eye_in_hand=eye_in_hand)
    out, calib = tmp_path / "frame.toml", tmp_path / "mine.calib"
    words = ["register", "--stops", str(path), "--robot", "ur5e", "-o", str(out)]
    words += ["--also", str(calib), *(["--eye-in-hand"] if eye_in_hand else [])]
    assert main(words) == 0
    found = read_frame(out)
    assert np.linalg.norm(found.world_from_base.difference(arm.world_from_base)[:3]) < 8.0
    assert np.linalg.norm(found.flange_from_body.difference(arm.flange_from_body)[:3]) < 4.0
    held = yaml.safe_load(calib.read_text())
    assert held["parameters"]["calibration_type"] == (
        "eye_in_hand" if eye_in_hand else "eye_on_base"
    )
    camera = found.flange_from_body if eye_in_hand else found.world_from_base.inverse()
    for part, values in _ros(camera).items():
        assert held["transform"][part] == pytest.approx(values, abs=1e-12)


def test_samples_that_say_otherwise_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = samples(tmp_path / "a.samples", eye_in_hand=True)
    words = ["register", "--stops", str(path), "--robot", "ur5e", "-o", str(tmp_path / "f.toml")]
    assert main(words) == 2
    assert "its calibration_type is eye_in_hand: give --eye-in-hand" in capsys.readouterr().err
    silent, _ = samples(tmp_path / "b.samples", eye_in_hand=True, says=False)
    assert read_samples(silent, eye_in_hand=True).eye_in_hand is None
    for text, said in (
        ("samples: 3", "holds no list 'samples'"),
        ("[{effector_wrt_world: [1], object_wrt_sensor: [1]}]", "1 numbers, not 16"),
        ("[]", "holds 0 samples"),
    ):
        path.write_text(text)
        with pytest.raises(EstimatorError, match=said):
            read_samples(path, eye_in_hand=False)


PSM = """/* as it comes */
{
    "DH": {
        "convention": "modified",
        "joints": [
            {"name": "outer_yaw", "alpha":  1.5708, "A": 0.0, "theta": 0.0, "D": 0.0,
             "type": "revolute", "offset":  1.5708, "qmin": -1.6 // deg
            },
            {"name": "outer_pitch", "alpha": -1.5708, "A": 0.0, "theta": 0.0, "D": 0.0,
             "type": "revolute", "offset": -1.5708},
            {"name": "outer_insertion", "alpha":  1.5708, "A": 0.0, "theta": 0.0, "D": 0.0,
             "type": "prismatic", "offset": -0.4318}
        ]
    }
}
"""


def _dvrk_chain(text: str) -> SerialChain:
    bare = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)
    joints = []
    for j in json.loads(bare)["DH"]["joints"]:
        slides = j["type"] == "prismatic"
        theta, d = (0.0, 1e3 * j["offset"]) if slides else (j["offset"], 0.0)
        link = dh_link(j["alpha"], 1e3 * j["A"], theta, d)
        joints.append(Joint(link, np.array([0.0, 0.0, 1.0]), slides))
    return SerialChain(tuple(joints), np.eye(4))


def test_zeros_go_into_the_offsets_of_a_dvrk(tmp_path: Path) -> None:
    """The arm of the new file stands where the old one's does with its joints moved."""
    path = tmp_path / "psm.json"
    path.write_text(PSM)
    zeros = {"outer_yaw": 0.01, "outer_pitch": -0.02, "outer_insertion": 0.0013, "outer_roll": 1.0}
    text = dvrk_with_offsets(path, zeros)
    q = np.random.default_rng(0).uniform([-0.5, -0.5, 80.0], [0.5, 0.5, 200.0], (20, 3))
    moved = _dvrk_chain(PSM).tip_mm(q + np.array([0.01, -0.02, 1.3]))
    assert np.linalg.norm(_dvrk_chain(text).tip_mm(q) - moved, axis=1).max() < 1e-3
    assert text.splitlines()[0] == "/* as it comes */"
    assert [a for a, b in zip(PSM.splitlines(), text.splitlines(), strict=True) if a != b] == [
        line for line in PSM.splitlines() if "offset" in line
    ]
    with pytest.raises(EstimatorError, match="no joint of it with an offset is one of outer_roll"):
        dvrk_with_offsets(path, {"outer_roll": 1.0})

"""Files that owners of robots have already: UR's calibration, hand-eye samples, dVRK's arm file.

UR's `calibration.yaml` (ur_robot_driver) holds where each joint's frame stands in the one before,
m and rad. easy_handeye2's `.samples` and `.calib`, and MoveIt's list of samples, hold transforms in
m. dVRK's kinematic files are JSON with comments, whose joints have an `offset` in rad or m.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.reading import LARGEST, read_text
from measure.robots.chain import Joint, SerialChain
from measure_learning.robots.urdf import roll_pitch_yaw

_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_UR_VALUES = ("x", "y", "z", "roll", "pitch", "yaw")
_MOST_BYTES = 8 << 20
_ALONG_Z, _NO_TOOL = 1e-9, 1e-9  # of an axis, of a transform: what rounding leaves
_MOST_SKEW = 1e-3  # of a rotation that was written with few digits
_INVERTED = "eye_on_base"  # kind of calibration for which easy_handeye2 stores the base in the tool


def read_ur_calibration(path: Path) -> SerialChain:
    """The chain of one UR arm, base to flange, that its factory measured; EstimatorError if not."""
    links = _held(path, _yaml(path), "kinematics", dict)
    joints = list[Joint]()
    for name in _UR_LINKS:
        values = _numbers(path, _held(path, links, name, dict), _UR_VALUES)
        turn = Rotation.from_euler("xyz", values[3:]).as_matrix()
        link = RigidTransform(turn, 1e3 * values[:3]).matrix
        joints.append(Joint(link, np.array([0.0, 0.0, 1.0])))
    return SerialChain(tuple(joints), np.eye(4))


def ur_calibration_text(chain: SerialChain) -> str:
    """The file of a chain; `read_ur_calibration` gives it again. EstimatorError: of another arm."""
    bent = [np.abs(joint.axis - [0, 0, 1]).max() > _ALONG_Z for joint in chain.joints]
    if chain.size != len(_UR_LINKS) or any(bent) or any(j.prismatic for j in chain.joints):
        raise EstimatorError("a calibration of UR holds six joints that turn about their z")
    if np.abs(chain.tool - np.eye(4)).max() > _NO_TOOL:
        raise EstimatorError("a calibration of UR ends at the flange: leave the tool out")
    links = {}
    for name, joint in zip(_UR_LINKS, chain.joints, strict=True):
        values = np.append(joint.link[:3, 3] / 1e3, roll_pitch_yaw(joint.link)).tolist()
        links[name] = dict(zip(_UR_VALUES, values, strict=True))
    return str(yaml.safe_dump({"kinematics": links}, sort_keys=False))


@dataclass(frozen=True, eq=False)
class HandEyeSamples:
    """Pairs of poses of another hand-eye program, mm."""

    base_from_tool: RigidTransform  # (n,)
    cameras_from_marker: RigidTransform  # (n,)
    eye_in_hand: bool | None  # None where the file does not say


def read_samples(path: Path, *, eye_in_hand: bool) -> HandEyeSamples:
    """Samples of easy_handeye2 (`.samples`) or MoveIt (a list in YAML).

    For cameras that do not move easy_handeye2 stores the base in the tool. `eye_in_hand` is what
    the user says, and must be what the file says, if it does. EstimatorError: neither format.
    """
    values = _yaml(path)
    if isinstance(values, list):
        pairs = [
            [_matrix(path, sample, name) for name in ("effector_wrt_world", "object_wrt_sensor")]
            for sample in values
        ]
        inverted, stated = False, None
    else:
        parameters = values.get("parameters") if isinstance(values, dict) else None
        kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
        stated = None if not kind else kind != _INVERTED
        samples = _held(path, values, "samples", list)
        pairs = [[_transform(path, s, name) for name in ("robot", "tracking")] for s in samples]
        inverted = not eye_in_hand
    if stated is not None and stated != eye_in_hand:
        option = "give --eye-in-hand" if stated else "leave --eye-in-hand out"
        raise EstimatorError(f"{path}: its calibration_type is {kind}: {option}")
    if len(pairs) < 2:
        raise EstimatorError(f"{path}: holds {len(pairs)} samples of a hand-eye calibration")
    robot, seen = (
        RigidTransform(matrices[:, :3, :3], matrices[:, :3, 3])
        for matrices in np.swapaxes(np.array(pairs), 0, 1)
    )
    return HandEyeSamples(robot.inverse() if inverted else robot, seen, stated)


def easy_handeye_text(name: str, camera: RigidTransform, *, eye_in_hand: bool) -> str:
    """easy_handeye2's `.calib`: where the cameras stand in the base, or on the flange."""
    w, *xyz = camera.quat_wxyz.tolist()
    parameters = {
        "name": name,
        "calibration_type": "eye_in_hand" if eye_in_hand else _INVERTED,
        "robot_base_frame": "base",
        "robot_effector_frame": "flange",
        "tracking_base_frame": "cameras" if eye_in_hand else "world",
        "tracking_marker_frame": "body",
        "freehand_robot_movement": True,
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    place = dict(zip("xyz", (camera.translation / 1e3).tolist(), strict=True))
    turn = dict(zip("xyzw", (*xyz, w), strict=True))
    held = {"parameters": parameters, "transform": {"translation": place, "rotation": turn}}
    return str(yaml.safe_dump(held, sort_keys=False))


def launch_text(transforms: list[list[str]]) -> str:
    """A launch file of ROS 2, as MoveIt's calibration writes it, of publishers' arguments."""
    nodes = "".join(
        "        Node(\n"
        '            package="tf2_ros",\n'
        '            executable="static_transform_publisher",\n'
        f"            arguments={words!r},\n"
        "        ),\n"
        for words in transforms
    )
    return (
        "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
        "def generate_launch_description() -> LaunchDescription:\n"
        f"    return LaunchDescription([\n{nodes}    ])\n"
    )


_OFFSET = re.compile(r'("offset"\s*:\s*)([-+0-9.eE]+)')


def dvrk_with_offsets(path: Path, zeros: Mapping[str, float]) -> str:
    """A kinematic file of the dVRK with these zeros, rad or m by joint, added to its offsets.

    Whatever else it holds stays as it is. EstimatorError: it has none of these joints.
    """
    text, done = read_text(path, EstimatorError, _MOST_BYTES), 0

    def joint(found: re.Match[str]) -> str:
        nonlocal done
        name = re.search(r'"name"\s*:\s*"([^"]*)"', found[0])
        zero = zeros.get(name[1]) if name else None
        offset = _OFFSET.search(found[0])
        if zero is None or offset is None:
            return found[0]
        done += 1
        return _OFFSET.sub(f"{offset[1]}{float(offset[2]) + zero:.9g}", found[0], count=1)

    out = re.sub(r"\{[^{}]*\}", joint, text)
    if not done:
        raise EstimatorError(
            f"{path}: no joint of it with an offset is one of {', '.join(zeros)}: give the arm's "
            "kinematic file, or the tool's"
        )
    return out


def _yaml(path: Path) -> Any:
    text = read_text(path, EstimatorError, _MOST_BYTES)
    try:
        return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, RecursionError, ValueError) as problem:
        raise EstimatorError(f"{path}: no YAML: {str(problem).splitlines()[0]}") from None


def _held(path: Path, values: Any, key: str, kind: type) -> Any:
    """What stands under a key; EstimatorError if there is no such thing."""
    held = values.get(key) if isinstance(values, dict) else None
    if not isinstance(held, kind):
        what = "list" if kind is list else "table"
        raise EstimatorError(f"{path}: holds no {what} '{key}'")
    return held


def _numbers(path: Path, values: dict[str, Any], keys: tuple[str, ...]) -> Floats:
    found = [values.get(key) for key in keys]
    for key, value in zip(keys, found, strict=True):
        if not isinstance(value, int | float) or not abs(value) <= LARGEST:
            raise EstimatorError(f"{path}: {key} is {value!r:.40}, no number within {LARGEST:g}")
    return np.array(found, dtype=np.float64)


def _transform(path: Path, sample: Any, name: str) -> Floats:
    """A transform (4, 4) in mm of easy_handeye2."""
    held = _held(path, sample, name, dict)
    place = _numbers(path, _held(path, held, "translation", dict), ("x", "y", "z"))
    turn = _numbers(path, _held(path, held, "rotation", dict), ("x", "y", "z", "w"))
    if not np.linalg.norm(turn) > 0.5:
        raise EstimatorError(f"{path}: a rotation of '{name}' is no unit quaternion")
    return RigidTransform(Rotation.from_quat(turn).as_matrix(), 1e3 * place).matrix


def _matrix(path: Path, sample: Any, name: str) -> Floats:
    """A transform (4, 4) in mm of MoveIt, row by row."""
    held = _held(path, sample, name, list)
    if len(held) != 16:
        raise EstimatorError(f"{path}: '{name}' has {len(held)} numbers, not 16 of a matrix")
    keys = tuple(map(str, range(16)))
    out = _numbers(path, dict(zip(keys, held, strict=True)), keys).reshape(4, 4)
    if np.abs(out[:3, :3] @ out[:3, :3].T - np.eye(3)).max() > _MOST_SKEW:
        raise EstimatorError(f"{path}: '{name}' holds a matrix that is no rotation")
    u, _, v = np.linalg.svd(out[:3, :3])
    return RigidTransform(u @ v, 1e3 * out[:3, 3]).matrix

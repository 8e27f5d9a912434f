"""Logs that hold the tool's pose and no joints: pairs of poses, as hand-eye programs take them.

The pose becomes the joints of a robot that slides along x, y and z and then turns about z, y and x:
all that is made for chains serves these logs too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.robots.chain import Joint, SerialChain
from measure.robots.schema import Feature, Reading, RobotLog, StateSchema
from measure_learning.robots.log_clock import Clock
from measure_learning.robots.tables import Table

_SLIDES, _TURNS = ("x", "y", "z"), ("rz", "ry", "rx")
_LONGEST_M = 10.0  # from a base to a tool; numbers within are metres
_MOST_RAD = 6.5  # of an angle; larger ones are degrees
_MOST_TURNED_RAD = 1.4  # of the middle angle, which is singular at a right angle
_TRIED, _COMPARED = 100, 200  # pairs of axes, and poses in which they must not meet


class ToolPoses(SerialChain):
    """Not the robot's links: a pose that the robot states, in the form of a chain."""


@dataclass(frozen=True)
class _Writing:
    """Names under which programs write a pose, and how they turn."""

    place: tuple[str, str, str]
    turn: tuple[str, ...]
    rotations: Callable[[Floats], Rotation]


def _angles(order: str) -> Callable[[Floats], Rotation]:
    def rotations(values: Floats) -> Rotation:
        in_degrees = bool((np.abs(values) > _MOST_RAD).any())
        return Rotation.from_euler(order, values, degrees=in_degrees)

    return rotations


def _quats(values: Floats) -> Rotation:
    return Rotation.from_quat(values)


_XYZ = ("x", "y", "z")
_WRITINGS = (
    _Writing(
        ("actual_TCP_pose_0", "actual_TCP_pose_1", "actual_TCP_pose_2"),
        ("actual_TCP_pose_3", "actual_TCP_pose_4", "actual_TCP_pose_5"),
        Rotation.from_rotvec,
    ),
    _Writing(("X", "Y", "Z"), ("A", "B", "C"), _angles("ZYX")),
    _Writing(_XYZ, ("qx", "qy", "qz", "qw"), _quats),
    _Writing(("x_mm", "y_mm", "z_mm"), ("qx", "qy", "qz", "qw"), _quats),
    _Writing(("tx", "ty", "tz"), ("qx", "qy", "qz", "qw"), _quats),
    _Writing(
        ("pose.position.x", "pose.position.y", "pose.position.z"),
        tuple(f"pose.orientation.{axis}" for axis in "xyzw"),
        _quats,
    ),
    _Writing(
        ("position.x", "position.y", "position.z"),
        tuple(f"orientation.{axis}" for axis in "xyzw"),
        _quats,
    ),
    _Writing(
        ("field.pose.position.x", "field.pose.position.y", "field.pose.position.z"),
        tuple(f"field.pose.orientation.{axis}" for axis in "xyzw"),
        _quats,
    ),
    _Writing(_XYZ, ("rx", "ry", "rz"), Rotation.from_rotvec),
    _Writing(_XYZ, ("yaw", "pitch", "roll"), _angles("ZYX")),
)


def holds_tool_poses(there: Sequence[str]) -> bool:
    """Whether headings are those of a tool's pose."""
    return any(set(there) >= {*one.place, *one.turn} for one in _WRITINGS)


def read_tool_poses(path: Path, schema: StateSchema) -> RobotLog:
    """The log of a robot that states its tool's pose; EstimatorError: it does not, or has no time.

    Lengths are in m where all are below 10, else in mm; angles beyond 6.5 are degrees.
    """
    table = Table.read(path)
    clock = Clock(str(path), table.schema.names, schema)
    states, chain = _states(path, table)
    times = clock.seconds(table.numbers(*clock.columns))
    good = np.isfinite(times)
    order = np.argsort(times[good], kind="stable")
    times, states = times[good][order], states[good][order]
    new = np.diff(times, prepend=-np.inf) > 0
    return RobotLog(_schema(schema, chain), times[new], states[new])


def tool_pose_states(path: Path, table: Table, schema: StateSchema) -> tuple[Floats, StateSchema]:
    """States (n, 9) of the rows of a table that states a tool's pose, and their schema."""
    states, chain = _states(path, table)
    return states, _schema(schema, chain)


def _states(path: Path, table: Table) -> tuple[Floats, SerialChain]:
    names = table.schema.names
    found = next((one for one in _WRITINGS if set(names) >= {*one.place, *one.turn}), None)
    if found is None:
        raise EstimatorError(f"{path}: holds no pose of the tool")
    place, turn = table.numbers(*found.place), table.numbers(*found.turn)
    good = np.isfinite(place).all(axis=1) & np.isfinite(turn).all(axis=1)
    if len(found.turn) == 4:
        good &= np.linalg.norm(turn, axis=1) > 0.5
    if good.sum() < 2:
        raise EstimatorError(f"{path}: holds {int(good.sum())} poses of the tool")
    in_metres = found.place[0] != "x_mm" and np.abs(place[good]).max() < _LONGEST_M
    rotations = found.rotations(turn[good])
    before, behind = _far_from_singular(rotations)
    angles = (before.inv() * rotations * behind.inv()).as_euler("ZYX")
    if np.abs(angles[:, 1]).max() > _MOST_TURNED_RAD:
        raise EstimatorError(
            f"{path}: the tool turns to all sides, so that no three angles describe it: give a log "
            "of the joints, or shorter stretches"
        )
    q = np.full((len(place), 6), np.nan)
    q[good] = np.column_stack([place[good] * (1e3 if in_metres else 1.0), angles])
    chain = _chain(before.as_matrix(), behind.as_matrix())
    tips = np.full((len(place), 3), np.nan)
    tips[good] = chain.tip_mm(q[good])
    return np.column_stack([q, tips]), chain


def _far_from_singular(rotations: Rotation) -> tuple[Rotation, Rotation]:
    """Rotations Q and M so that the middle one of the angles of Q^-1 R M^-1 stays small.

    Its sine is how far M's first axis leans towards Q's third: axes that never meet are chosen.
    """
    some = rotations[:: -(-len(rotations) // _COMPARED)].as_matrix()
    tries = Rotation.random(_TRIED, rng=0)
    axes = tries.as_matrix()
    ours, theirs = axes[:, :, 2], axes[:, 0]  # Q's third axis and M's first one, transposed
    lean = np.abs(np.einsum("qi,nij,mj->qmn", ours, some, theirs, optimize=True)).max(axis=2)
    best = np.unravel_index(int(np.argmin(lean)), lean.shape)
    return tries[int(best[0])], tries[int(best[1])]


def _chain(before: Floats, behind: Floats) -> SerialChain:
    start, tool, axes = np.eye(4), np.eye(4), np.eye(3)
    start[:3, :3], tool[:3, :3] = before, behind
    slides = [Joint(np.eye(4), axis, prismatic=True) for axis in axes]
    turns = [Joint(start, axes[2]), Joint(np.eye(4), axes[1]), Joint(np.eye(4), axes[0])]
    return ToolPoses((*slides, *turns), tool)


def _schema(schema: StateSchema, chain: SerialChain) -> StateSchema:
    names = (*_SLIDES, *_TURNS)
    tips = [Feature(f"tip_{axis}", "mm") for axis in _SLIDES]
    units = ["mm"] * 3 + ["rad"] * 3
    x, y, z = (Reading.of(feature.name) for feature in tips)
    return replace(
        schema,
        features=(*(Feature(name, unit) for name, unit in zip(names, units, strict=True)), *tips),
        position=(x, y, z),
        joints=tuple(Reading.of(name) for name in names),
        chain=chain,
        coupled=(),
        torques=(),
        groups={},
    )

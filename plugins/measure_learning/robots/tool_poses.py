"""Logs that hold the tool's pose and no joints: pairs of poses, as hand-eye programs take them.

The pose becomes the joints of a robot that slides along x, y and z and then turns about z, y and x:
all that is made for chains serves these logs too. Makers write one rotation in different ways under
like headings: every usual reading of a log's headings is given, for the poses to choose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, cast

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots.chain import Joint, SerialChain
from measure.robots.schema import Feature, Reading, RobotLog, StateSchema
from measure.session import MM_PER
from measure_learning.robots.headings import Clock, ToolHeadings, split_unit
from measure_learning.robots.tables import Table

Angles = Literal[
    "abb", "doosan", "fanuc", "kawasaki", "kuka", "matrix", "mitsubishi", "ros", "staubli", "ur",
    "yaskawa",
]  # fmt: skip
"""Makers, and programs, by the way in which they write a rotation."""

_FIXED = ("xyz", "about the fixed x, then y, then z")
_MOVED_ZYZ = ("ZYZ", "about z, the moved y, the moved z")
_EULER = {
    "kuka": ("ZYX", "about z, the moved y, the moved x"),
    "fanuc": _FIXED,
    "mitsubishi": _FIXED,
    "yaskawa": _FIXED,
    "doosan": _MOVED_ZYZ,
    "kawasaki": _MOVED_ZYZ,
    "staubli": ("XYZ", "about x, the moved y, the moved z"),
}
_QUATERNIONS = {"abb": ([1, 2, 3, 0], "w first"), "ros": ([0, 1, 2, 3], "w last")}
_SLIDES, _TURNS = ("x", "y", "z"), ("rz", "ry", "rx")
_LONGEST_M = 10.0  # from a base to a tool; numbers within are metres
_MOST_RAD = 6.5  # of an angle; larger ones are degrees
_MOST_TURNED_RAD = 1.4  # of the middle angle, which is singular at a right angle
_TRIED, _COMPARED = 100, 200  # pairs of axes, and poses in which they must not meet
_MOST_SKEW = 0.02  # of a rotation's matrix, whose numbers are rounded


class ToolPoses(SerialChain):
    """Not the robot's links: a pose that the robot states, in the form of a chain."""


@dataclass(frozen=True, eq=False)
class ToolReading:
    """One way of reading a log's poses of the tool."""

    angles: Angles
    words: str  # which headings, and how they are read
    states: Floats  # (n, 9)
    schema: StateSchema

    def log(self, times_s: Floats) -> RobotLog:
        """States in the order of times (n,); rows without a time, or of the same, are left out."""
        order = np.argsort(times_s, kind="stable")[: int(np.isfinite(times_s).sum())]
        order = order[np.diff(times_s[order], prepend=-np.inf) > 0]
        return RobotLog(self.schema, times_s[order], self.states[order])


def read_tool_poses(
    path: Path, schema: StateSchema, angles: Angles | None = None
) -> list[tuple[ToolReading, RobotLog]]:
    """The log of a robot that states its tool's pose, in each usual reading; see `tool_readings`.

    EstimatorError: it has no time.
    """
    table = Table.read(path)
    clock = Clock(str(path), table.schema.names, schema)
    times = clock.seconds(table.numbers(*clock.columns))
    return [(r, r.log(times)) for r in tool_readings(path, table, schema, angles)]


def tool_readings(
    path: Path, table: Table, schema: StateSchema, angles: Angles | None = None
) -> list[ToolReading]:
    """The usual readings of a table's poses of the tool, the likeliest first; or `angles` alone.

    Lengths whose headings state no unit are in m where all are below 10, else in mm; angles beyond
    6.5 are degrees, others radians or degrees. EstimatorError: no poses, or `angles` are not these.
    """
    headings = ToolHeadings.of(table.schema.names)
    if headings is None:
        raise EstimatorError(f"{path}: holds no pose of the tool")
    makers = headings.makers
    if angles is not None:
        alike = [set(_EULER) | {"ur"}, set(_QUATERNIONS), {"matrix"}]
        if not any({angles, makers[0]} <= kind for kind in alike):
            raise EstimatorError(
                f"{path}: {', '.join(headings.turn[:4])} are not as {angles} writes rotations"
            )
        makers = (angles,)
    place, turn = _numbers(table, headings)
    good = np.asarray(np.isfinite(np.hstack([place, turn])).all(axis=1))
    if turn.shape[1] == 4:
        good &= np.linalg.norm(turn, axis=1) > 0.5
    if good.sum() < 2:
        raise EstimatorError(f"{path}: holds {int(good.sum())} poses of the tool")
    place *= MM_PER.get(
        split_unit((headings.place or headings.turn)[0])[1],
        1e3 if np.abs(place[good]).max() < _LONGEST_M else 1.0,
    )
    found, problem = list[ToolReading](), EstimatorError("")
    for maker in makers:
        for unit in _angle_units(headings, turn[good]):
            rotations, words = _rotations(path, maker, unit, turn[good])
            try:
                states, chain = _states(path, place, good, rotations)
            except EstimatorError as reason:
                problem = reason
                continue
            more = " ..." if maker == "matrix" else ""
            said = f"{', '.join(headings.turn[:4])}{more} as {maker} writes them ({words})"
            found.append(ToolReading(cast("Angles", maker), said, states, _schema(schema, chain)))
    if not found:
        raise problem
    return found


def reading_of(path: Path, poses: RigidTransform, schema: StateSchema, words: str) -> ToolReading:
    """Poses (n,) of the tool in the base, mm, as states; `words` say how they were read."""
    good = np.ones(len(poses.translation), dtype=bool)
    turns = Rotation.from_matrix(poses.rotation)
    states, chain = _states(path, poses.translation, good, turns)
    return ToolReading("ros", words, states, _schema(schema, chain))


def _numbers(table: Table, headings: ToolHeadings) -> tuple[Floats, Floats]:
    """Places (n, 3) and turns (n, 3, 4 or 9) as they are written."""
    if len(headings.turn) < 16:
        return table.numbers(*headings.place), table.numbers(*headings.turn)
    named = [name for name in headings.turn if name]
    pose = np.tile(np.eye(4).ravel(), (len(table), 1))
    pose[:, : len(named)] = table.numbers(*named)
    pose = pose.reshape(-1, 4, 4)
    if np.nanmedian(np.abs(pose[:, 3, :3])) > np.nanmedian(np.abs(pose[:, :3, 3])):
        pose = np.swapaxes(pose, 1, 2)  # column by column
    return pose[:, :3, 3].copy(), pose[:, :3, :3].reshape(-1, 9)


def _angle_units(headings: ToolHeadings, turn: Floats) -> list[str]:
    """Units that angles may be in; one without a name if they are no angles."""
    if turn.shape[1] != 3:
        return [""]
    if np.abs(turn).max() > _MOST_RAD:
        return ["deg"]
    stated = {split_unit(name)[1][:3] for name in headings.turn} & {"deg", "rad", "°"}
    return ["deg" if unit == "°" else unit for unit in stated] or ["rad", "deg"]


def _rotations(path: Path, maker: str, unit: str, turn: Floats) -> tuple[Rotation, str]:
    """Rotations (n) as a maker writes them, and how that is."""
    if maker == "matrix":
        R = turn.reshape(-1, 3, 3)
        if np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() > _MOST_SKEW:
            raise EstimatorError(f"{path}: its matrices are no rotations")
        return Rotation.from_matrix(R), "row by row"
    if maker in _QUATERNIONS:
        order, words = _QUATERNIONS[maker]
        return Rotation.from_quat(turn[:, order]), words
    values, of_unit = (np.deg2rad(turn), "degrees") if unit == "deg" else (turn, "radians")
    if maker == "ur":
        return Rotation.from_rotvec(values), f"a rotation vector in {of_unit}"
    order_of_axes, words = _EULER[maker]
    return Rotation.from_euler(order_of_axes, values), f"{of_unit} {words}"


def _states(
    path: Path, place: Floats, good: Bools, rotations: Rotation
) -> tuple[Floats, SerialChain]:
    """States (n, 9) of places (n, 3) in mm and the rotations of the good rows, and their chain."""
    before, behind = _far_from_singular(rotations)
    angles = (before.inv() * rotations * behind.inv()).as_euler("ZYX")
    if np.abs(angles[:, 1]).max() > _MOST_TURNED_RAD:
        raise EstimatorError(
            f"{path}: the tool turns to all sides, so that no three angles describe it: give a log "
            "of the joints, or shorter stretches"
        )
    q = np.full((len(place), 6), np.nan)
    q[good] = np.column_stack([place[good], angles])
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

"""Serial chains from URDF files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.reading import read_text
from measure.robots.chain import Joint, SerialChain

_TURNS, _SLIDES, _STILL = ("revolute", "continuous"), "prismatic", "fixed"
_MOST_BYTES = 8 << 20


def read_urdf(
    path: Path, base: str | None = None, tip: str | None = None
) -> tuple[tuple[str, ...], SerialChain]:
    """Names of the moving joints from the base link to the tip, and their chain.

    Args:
        base: a link; the root if absent.
        tip: a link; the only one without a child if absent.

    Raises:
        EstimatorError: no URDF, no such links, several tips, or a joint of another kind than
            revolute, continuous, prismatic and fixed, or coupled to another one.
    """
    names, joints = [], list[Joint]()
    link = np.eye(4)
    for element in _path(path, base, tip):
        link = link @ _origin(path, element)
        kind, name = element.get("type"), element.get("name", "")
        if kind == _STILL:
            continue
        if kind not in (*_TURNS, _SLIDES) or element.find("mimic") is not None:
            how = "mimics another joint" if kind in (*_TURNS, _SLIDES) else f"is {kind}"
            raise EstimatorError(
                f"{path}: joint '{name}' {how}: a chain of single joints is needed"
            )
        axis = _numbers(path, element.find("axis"), "xyz", "1 0 0")
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise EstimatorError(f"{path}: joint '{name}' has an axis of length 0")
        names.append(name)
        joints.append(Joint(link, axis / length, kind == _SLIDES))
        link = np.eye(4)
    if not joints:
        raise EstimatorError(f"{path}: no joint moves between {base or 'the root'} and the tip")
    return tuple(names), SerialChain(tuple(joints), link)


def _path(path: Path, base: str | None, tip: str | None) -> Iterator[ET.Element]:
    """The joints from base to tip."""
    try:
        root = ET.fromstring(read_text(path, EstimatorError, _MOST_BYTES))
    except ET.ParseError as problem:
        raise EstimatorError(f"{path}: no URDF: {problem} (xacro must be expanded)") from None
    by_child = {_link(joint, "child"): joint for joint in root.findall("joint")}
    parents = {_link(joint, "parent") for joint in by_child.values()}
    leaves = sorted(by_child.keys() - parents)
    if tip is None and len(leaves) != 1:
        raise EstimatorError(
            f"{path}: name the link of the tip (tip = ...): its chains end in "
            f"{', '.join(leaves) or 'no link'}"
        )
    found = list[ET.Element]()
    at = tip or leaves[0]
    while at in by_child and at != base and len(found) <= len(by_child):
        found.append(by_child[at])
        at = _link(found[-1], "parent")
    if not found or (base is not None and at != base) or (at in by_child and base is None):
        raise EstimatorError(
            f"{path}: no chain leads from link '{base or 'root'}' to '{tip or leaves[0]}'; its "
            f"links: {', '.join(sorted(by_child.keys() | parents))}"
        )
    yield from reversed(found)


def _link(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _origin(path: Path, joint: ET.Element) -> Floats:
    """Parent-from-child transform (4, 4) in mm at joint position 0; angles roll, pitch, yaw."""
    origin = joint.find("origin")
    shift = 1e3 * _numbers(path, origin, "xyz", "0 0 0")
    turn = RigidTransform.identity()
    for axis, angle in zip(np.eye(3), _numbers(path, origin, "rpy", "0 0 0"), strict=True):
        turn = RigidTransform.from_rotvec(angle * axis) @ turn
    return RigidTransform(turn.rotation, shift).matrix


def _numbers(path: Path, element: ET.Element | None, key: str, default: str) -> Floats:
    text = default if element is None else element.get(key, default)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != 3 or not np.isfinite(values).all():
        raise EstimatorError(f'{path}: {key}="{text}" is not three numbers')
    return values

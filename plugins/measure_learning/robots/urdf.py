"""The chain of a robot's joints as a URDF describes it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.reading import LARGEST, read_text
from measure.robots.chain import Joint, SerialChain
from measure.robots.schema import StateSchema

_TURNS, _SLIDES, _STILL = ("revolute", "continuous"), "prismatic", "fixed"
_MOST_BYTES = 8 << 20
_EXPAND = "{0}: holds xacro that is not expanded: run `xacro {0} > arm.urdf`, and give arm.urdf"


@dataclass(frozen=True)
class Follows:
    """How a chain's joint follows a joint of the robot: value = ratio * feature, in rad or m."""

    feature: str  # a joint's name; its own, but of one that mimics another
    ratio: float = 1.0


def read_urdf(
    path: Path, base: str | None = None, tip: str | None = None
) -> tuple[tuple[Follows, ...], SerialChain]:
    """What the moving joints from the base link to the tip follow, and their chain.

    The base is the root if absent, the tip the only link without a child. A joint that mimics
    another one, as those of parallelograms and four-bar linkages do, follows it; what it is ahead
    by is in its link. EstimatorError: no URDF, no such links, several tips, or a joint of another
    kind than revolute, continuous, prismatic and fixed.
    """
    names, joints = list[Follows](), list[Joint]()
    link = np.eye(4)
    for element in _path(path, base, tip):
        link = link @ _origin(path, element)
        kind, name = element.get("type"), element.get("name", "")
        if kind == _STILL:
            continue
        if kind not in (*_TURNS, _SLIDES):
            raise EstimatorError(
                f"{path}: joint '{name}' is {kind}: a chain of single joints is needed"
            )
        axis = _numbers(path, element.find("axis"), "xyz", "1 0 0")
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise EstimatorError(f"{path}: joint '{name}' has an axis of length 0")
        axis /= length
        follows, ahead = _mimicked(path, element, name)
        if kind == _SLIDES:
            link = link @ RigidTransform(np.eye(3), 1e3 * ahead * axis).matrix
        else:
            link = link @ RigidTransform.from_rotvec(ahead * axis).matrix
        names.append(follows)
        joints.append(Joint(link, axis, kind == _SLIDES))
        link = np.eye(4)
    if not joints:
        raise EstimatorError(f"{path}: no joint moves between {base or 'the root'} and the tip")
    return tuple(names), SerialChain(tuple(joints), link)


def joint_names(schema: StateSchema) -> list[str]:
    """Of a schema's joints, by their features; numbered where two follow one feature."""
    names = [reading.terms[0][0] for reading in schema.joints]
    if len({*names}) < len(names):
        names = [f"joint_{k + 1}" for k in range(len(names))]
    return names


def urdf_text(robot: str, names: Sequence[str], chain: SerialChain) -> str:
    """A URDF of a chain whose joints have `names`; `read_urdf` gives the same chain."""
    root = ET.Element("robot", name=robot)
    links = ["base_link", *(f"link_{k + 1}" for k in range(chain.size)), "tip"]
    for link in links:
        ET.SubElement(root, "link", name=link)
    steps = [(joint.link, joint) for joint in chain.joints] + [(chain.tool, None)]
    for k, (matrix, joint) in enumerate(steps):
        kind = _STILL if joint is None else _SLIDES if joint.prismatic else _TURNS[1]
        element = ET.SubElement(root, "joint", name=(*names, "to_tip")[k], type=kind)
        ET.SubElement(element, "parent", link=links[k])
        ET.SubElement(element, "child", link=links[k + 1])
        rpy = roll_pitch_yaw(matrix)
        ET.SubElement(element, "origin", xyz=_words(matrix[:3, 3] / 1e3), rpy=_words(rpy))
        if joint is not None:
            ET.SubElement(element, "axis", xyz=_words(joint.axis))
        if kind == _SLIDES:
            ET.SubElement(element, "limit", lower="-10", upper="10", effort="0", velocity="0")
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def roll_pitch_yaw(matrix: Floats) -> Floats:
    """Angles (3,) in rad of a transform (4, 4); the last is 0 where the second is a right angle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of scipy, that it chose that
        return np.asarray(Rotation.from_matrix(matrix[:3, :3]).as_euler("xyz"))


def _words(values: Floats) -> str:
    return " ".join(f"{value:.12g}" for value in values + 0.0)


def _mimicked(path: Path, joint: ET.Element, name: str) -> tuple[Follows, float]:
    """What a joint follows, and by how much it is ahead, rad or m; of itself if it is free."""
    mimic = joint.find("mimic")
    if mimic is None:
        return Follows(name), 0.0
    values = []
    for key, usual in (("multiplier", "1"), ("offset", "0")):
        try:
            values.append(float(mimic.get(key, usual)))
        except ValueError:
            values.append(np.nan)
        if not abs(values[-1]) <= LARGEST:
            raise EstimatorError(
                f"{path}: joint '{name}': mimic {key}=\"{mimic.get(key, '')[:60]}\" is no number "
                f"within {LARGEST:g}"
            )
    return Follows(mimic.get("joint", ""), values[0]), values[1]


def _path(path: Path, base: str | None, tip: str | None) -> Iterator[ET.Element]:
    """The joints from base to tip."""
    text = read_text(path, EstimatorError, _MOST_BYTES)
    if "<xacro:" in text:
        raise EstimatorError(_EXPAND.format(path))
    try:
        root = ET.fromstring(text)
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
    if "${" in text or "$(" in text:
        raise EstimatorError(_EXPAND.format(path))
    if len(values) != 3 or not (np.abs(values) <= LARGEST).all():
        raise EstimatorError(f'{path}: {key}="{text[:60]}" is not three numbers within {LARGEST:g}')
    return values

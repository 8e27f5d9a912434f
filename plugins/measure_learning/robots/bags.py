"""States in ROS 1 bags, ROS 2 bags and MCAP files, without ROS.

RAVEN-II's are `raven_state` messages; other robots' joints are `sensor_msgs/JointState`, and their
tip is a `PoseStamped` or `TransformStamped` topic, comes from /tf, or is computed.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.bags import described, open_bag, stamp_ns
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.robots.schema import StateSchema
from measure_learning.robots.headings import FeatureColumns, find_columns, heading_hint
from measure_learning.robots.raven import FIELDS, Field, raven_schema
from measure_learning.robots.tables import PIECE_ROWS

_log = logging.getLogger(__name__)

_JOINTS = "sensor_msgs/msg/JointState"
_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")
_TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_LOOKED_AT = 100  # Messages of a topic that tell which joints it has
_LONGEST_GAP_S = 0.25  # Between poses of the tip, across which its position is not interpolated
_FIELDS = (("position", ""), ("velocity", ".velocity"), ("effort", ".effort"))


@dataclass(frozen=True, eq=False)
class _Joints:
    """A topic of joint states."""

    topic: str
    connections: list[Any]  # several, if several programs publish it
    columns: tuple[str, ...]  # what `_cells` makes of its messages

    def fit(self, schema: StateSchema) -> FeatureColumns | list[str]:
        """Where the features are, that of the tip's position, which other topics hold, aside."""
        tip = {name for reading in schema.position for name, _ in reading.terms}
        found = find_columns(schema, self.columns)
        if isinstance(found, list) and set(found) <= tip:
            return find_columns(schema, (*self.columns, *tip))
        return found


def joint_rows(
    path: Path, reader: Any, schema: StateSchema, topic: str | None
) -> Iterator[tuple[float, Floats]]:
    """Stamps in s and states (features,) of the only topic of joint states that fits the schema."""
    joints = _choose(path, reader, schema, topic)
    found = joints.fit(schema)
    assert not isinstance(found, list)
    tip = {name for reading in schema.position for name, _ in reading.terms}
    poses = None
    if found.computed or not tip <= set(joints.columns):
        poses = _tip_poses(path, reader, schema, joints.topic)
    place = schema.index([reading.terms[0][0] for reading in schema.position])
    scales = np.array([reading.terms[0][1] for reading in schema.position])
    needed_columns = [column for column in found.columns if column in joints.columns]
    for stamp_s, cells in _whole(path, reader, joints, needed_columns):
        values = np.array([[cells.get(column, np.nan) for column in found.columns]])
        state = found.states(f"{path}: {joints.topic}", values)[0]
        if poses is not None:
            state[place] = _interpolate(*poses, stamp_s) / scales
        yield stamp_s, state


def _whole(
    path: Path, reader: Any, joints: _Joints, columns: list[str]
) -> Iterator[tuple[float, dict[str, float]]]:
    """Stamps and cells of the messages that hold all columns; else joined from those of parts."""
    messages = (
        (stamp_s, cells)
        for stamp_s, cells in _messages(reader, joints.connections)
        if any(column in cells for column in columns)  # not of a gripper
    )
    first = list(itertools.islice(messages, _LOOKED_AT))
    if any(all(column in cells for column in columns) for _, cells in first):
        yield from itertools.chain(first, messages)
    else:
        yield from _joined(path, joints.topic, itertools.chain(first, messages), columns)


def _joined(
    path: Path, topic: str, messages: Iterator[tuple[float, dict[str, float]]], columns: list[str]
) -> Iterator[tuple[float, dict[str, float]]]:
    """Parts of several publishers, interpolated at the stamps of the one that is the slowest."""
    series: dict[str, tuple[list[float], list[float]]] = {c: ([], []) for c in columns}
    for stamp_s, cells in messages:
        for column in columns:
            if column in cells:
                series[column][0].append(stamp_s)
                series[column][1].append(cells[column])
    times, order = {}, {}
    for column, (stamps, _) in series.items():
        times[column], order[column] = np.unique(np.array(stamps), return_index=True)
    slowest = min(times.values(), key=len)
    if len(slowest) < 2:
        raise EstimatorError(
            f"{path}: {topic}: its messages hold parts of the robot's joints (it has several "
            f"publishers), and {len(slowest)} of one part: record a topic that holds all"
        )
    values = []
    for column, (_, held) in series.items():
        own, at = times[column], np.array(held)[order[column]]
        right = np.clip(np.searchsorted(own, slowest), 1, len(own) - 1)
        near = np.minimum(np.abs(slowest - own[right - 1]), np.abs(own[right] - slowest))
        line = np.interp(slowest, own, at)
        values.append(np.where(near <= _LONGEST_GAP_S, line, np.nan))
    for row, stamp_s in enumerate(slowest.tolist()):
        yield stamp_s, {c: float(v[row]) for c, v in zip(columns, values, strict=True)}


def _choose(path: Path, reader: Any, schema: StateSchema, topic: str | None) -> _Joints:
    """The topic that holds the robot's joints."""
    groups: dict[str, list[Any]] = {}
    for connection in reader.connections:
        if connection.msgtype == _JOINTS and topic in (None, connection.topic):
            groups.setdefault(connection.topic, []).append(connection)
    topics = []
    for name, connections in groups.items():
        first = itertools.islice(_messages(reader, connections), _LOOKED_AT)
        columns = dict.fromkeys(column for _, cells in first for column in cells)
        topics.append(_Joints(name, connections, tuple(columns)))
    fitting = [one for one in topics if not isinstance(one.fit(schema), list)]
    for end in schema.log.topics:
        preferred = [one for one in fitting if one.topic.endswith(f"/{end}") or one.topic == end]
        if preferred:
            fitting = preferred
            break
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(one.topic for one in fitting)
        raise EstimatorError(f"{path}: the joints may be those of {names}: say which with --topic")
    hint = "".join(heading_hint(schema, one.columns) for one in topics)
    wanted = [name for reading in schema.joints for name, _ in reading.terms] or schema.names
    held = "; ".join(
        f"{one.topic} has {', '.join(c for c in one.columns if '.' not in c and '[' not in c)}"
        for one in topics
    )
    raise EstimatorError(
        f"{path}: no topic{f' {topic}' if topic else ''} of JointState messages has the joints of "
        f"{schema.robot} ({', '.join(wanted)}); "
        + (held or f"the bag has {described(reader.connections)}")
        + (hint or ": name the topic with --topic, or the robot with --robot")
    )


def _messages(reader: Any, connections: list[Any]) -> Iterator[tuple[float, dict[str, float]]]:
    for connection, received_ns, raw in reader.messages(connections=connections):
        message = reader.deserialize(raw, connection.msgtype)
        yield _stamp_s(message.header, received_ns), _cells(connection.topic, message)


def _stamp_s(header: Any, received_ns: int) -> float:
    """When a message was made; when it was recorded, if it does not say."""
    return 1e-9 * stamp_ns(header, received_ns)


def _cells(topic: str, message: Any) -> dict[str, float]:
    """Positions by the joints' names; velocities and efforts with an ending.

    CRTK's topics have the robot's order, and so positions by place; others may be sorted by name.
    """
    by_place = enumerate(message.position) if topic.endswith("_js") else ()
    out = {f"position[{i}]": float(value) for i, value in by_place}
    for field, ending in _FIELDS:
        values = getattr(message, field)
        if len(values) == len(message.name):
            pairs = zip(message.name, values, strict=True)
            out |= {f"{name}{ending}": float(value) for name, value in pairs}
    return out


def _tip_poses(
    path: Path, reader: Any, schema: StateSchema, topic: str
) -> tuple[Floats, Floats] | None:
    """Times (n,) and positions (n, 3) mm of the tip; None if they are to be computed.

    Those that belong to the joints by CRTK's names, or that the schema names; the only topic of
    poses counts where the chain is not known.
    """
    poses = {c.topic: c for c in reader.connections if c.msgtype in _POSES}
    named = [topic.removesuffix("_js") + "_cp"] if topic.endswith("_js") else []
    for name in (*named, *schema.log.tip_topics):
        if name in poses:
            return _sorted(_posed(reader, poses[name]))
    if schema.log.frames is not None:
        found = _sorted(_from_tree(reader, *schema.log.frames))
        if len(found[0]):
            return found
    if schema.chain is not None:
        return None
    if len(poses) != 1:
        raise EstimatorError(
            f"{path}: {len(poses)} topics hold a pose; it has {described(reader.connections)}: "
            "name one in a robot.toml, [log] tip_topics or frames, or give the robot's chain"
        )
    return _sorted(_posed(reader, *poses.values()))


def _posed(reader: Any, connection: Any) -> Iterator[tuple[float, Floats]]:
    for _, received_ns, raw in reader.messages(connections=[connection]):
        message = reader.deserialize(raw, connection.msgtype)
        body = message.pose.position if hasattr(message, "pose") else message.transform.translation
        yield _stamp_s(message.header, received_ns), 1e3 * np.array([body.x, body.y, body.z])


def _from_tree(reader: Any, base: str, tip: str) -> Iterator[tuple[float, Floats]]:
    """Positions of a frame in another one, whenever a frame between them moves."""
    parents: dict[str, tuple[str, RigidTransform]] = {}
    trees = [c for c in reader.connections if c.msgtype in _TREES]
    for connection, received_ns, raw in reader.messages(connections=trees) if trees else ():
        stamps = {}
        for one in reader.deserialize(raw, connection.msgtype).transforms:
            child = one.child_frame_id.lstrip("/")
            t, r = one.transform.translation, one.transform.rotation
            parent_from_child = RigidTransform.from_quat_wxyz(
                [r.w, r.x, r.y, r.z], 1e3 * np.array([t.x, t.y, t.z])
            )
            parents[child] = (one.header.frame_id.lstrip("/"), parent_from_child)
            stamps[child] = _stamp_s(one.header, received_ns)
        at, moved_s, base_from_tip = tip, list[float](), RigidTransform.identity()
        for _ in range(len(parents)):
            if at == base or at not in parents:
                break
            moved_s += [stamps[at]] if at in stamps else []
            at, parent_from_child = parents[at]
            base_from_tip = parent_from_child @ base_from_tip
        if at == base and moved_s and not connection.topic.endswith("static"):
            yield max(moved_s), base_from_tip.translation


def _sorted(poses: Iterator[tuple[float, Floats]]) -> tuple[Floats, Floats]:
    found = list(poses)
    times = np.array([time for time, _ in found])
    order = np.argsort(times, kind="stable")
    return times[order], np.array([place for _, place in found]).reshape(-1, 3)[order]


def _interpolate(times: Floats, places: Floats, at_s: float) -> Floats:
    """The position (3,) at an instant; NaN where no poses are near on both sides."""
    right = int(np.searchsorted(times, at_s))
    if right < len(times) and times[right] == at_s:
        return places[right]
    if not 0 < right < len(times) or times[right] - times[right - 1] > _LONGEST_GAP_S:
        return np.full(3, np.nan)
    share = (at_s - times[right - 1]) / (times[right] - times[right - 1])
    return np.asarray(places[right - 1] + share * (places[right] - places[right - 1]))


MESSAGE = "raven_2/msg/raven_state"
# Of the robot's public control software; ROS 2 has no `duration` word of its own.
DEFINITION = Path(__file__).with_name("builtin").joinpath("raven_state.msg").read_text("utf-8")


def _register_raven(store: Any, typesys: Any) -> None:
    store.register(typesys.get_types_from_msg(DEFINITION, MESSAGE))


def bag_pieces(
    path: Path, schema: StateSchema, topic: str | None = None, *, again: bool = False
) -> Iterator[tuple[Floats, Floats]]:
    """Stamps (n,) in s and states (n, features) of one arm from a bag, piece by piece.

    That the bag was cut off is not said `again`.
    """
    states = _bag_states(path, schema, topic, again)
    while some := list(itertools.islice(states, PIECE_ROWS)):
        times, rows = zip(*some, strict=True)
        yield np.array(times), np.array(rows)


def _bag_states(
    path: Path, schema: StateSchema, topic: str | None, again: bool
) -> Iterator[tuple[float, Floats]]:
    arm, count = _ARMS.get(schema.robot), 0
    with open_bag(path, EstimatorError, register=_register_raven) as bag:
        if arm is None:
            rows = joint_rows(path, bag, schema, topic)
        else:
            rows = _raven_rows(path, bag, arm, schema, topic)
        for row in rows:
            yield row
            count += 1
        if bag.cut_off and not again:
            _log.warning("%s", bag.cut_off)
    if not count:
        raise EstimatorError(f"{path}: holds no message of the robot's topic")


_ARMS = {raven_schema("left").robot: 0, raven_schema("right").robot: 1}


def held_fields(path: Path, schema: StateSchema, topic: str | None) -> set[str]:
    """The fields of a bag's `raven_state`, which depend on the robot's software; none of others."""
    if schema.robot not in _ARMS:
        return set()
    with open_bag(path, EstimatorError, register=_register_raven) as bag:
        (connection,) = _raven_topic(path, bag, topic)
        for _, _, raw in bag.messages(connections=[connection]):
            return set(vars(bag.deserialize(raw, connection.msgtype)))
    return set()


def _raven_topic(path: Path, reader: Any, topic: str | None) -> list[Any]:
    of_type = (c for c in reader.connections if c.msgtype.lower().endswith("raven_state"))
    found = [c for c in reader.connections if c.topic == topic] if topic else [*of_type]
    if len(found) != 1:
        raise EstimatorError(
            f"{path}: {len(found)} topics match {topic or 'raven_state'}; it has "
            f"{described(reader.connections)}: name one with --topic, or the robot with --robot"
        )
    return found


def _raven_rows(
    path: Path, reader: Any, arm: int, schema: StateSchema, topic: str | None
) -> Iterator[tuple[float, Floats]]:
    found = _raven_topic(path, reader, topic)
    fields = [field for field in FIELDS if field.name in schema.groups]
    for _, _, raw in reader.messages(connections=found):
        message = reader.deserialize(raw, found[0].msgtype)
        stamp = message.hdr.stamp
        yield stamp.sec + 1e-9 * stamp.nanosec, _row(path, message, arm, fields)


def _row(path: Path, message: Any, arm: int, fields: Sequence[Field]) -> Floats:
    parts = []
    for field in fields:
        values = getattr(message, field.name, None)
        if values is None or len(values) != 2 * field.per_arm:
            size = "no" if values is None else f"{len(values)} numbers in"
            raise EstimatorError(
                f"{path}: {size} field '{field.name}', expected {2 * field.per_arm}: "
                "the robot's software is older or newer than this schema"
            )
        parts.append(np.asarray(values)[arm * field.per_arm : (arm + 1) * field.per_arm])
    return np.concatenate(parts).astype(np.float64)

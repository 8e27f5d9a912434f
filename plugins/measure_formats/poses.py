"""Poses over time in bags of ROS, and in tables whose headings say which number is what.

Such as EuRoC's ground truth (`#timestamp [ns], p_RS_R_x [m], ..., q_RS_w [], ...`), what
`rostopic echo -p` writes, and exports of PlotJuggler.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from measure.bags import Bag, described, is_bag, open_bag, split_topic, stamp_ns
from measure.errors import MeasureError
from measure.session import MM_PER, TrackedBody
from measure.session.trajectory import COLUMNS
from measure.tables import Dialect, csv_rows, time_columns

_UNIT = re.compile(r"\s*[\[(](?P<unit>.*)[\])]$|_(?P<suffix>mm|cm|m)$")
_PLACE = re.compile(r"(.*[._/:])?(p(os(ition)?)?|t(rans(lation)?)?|p_[a-z_]+)?")
_OF_ROS = re.compile(r"(.*[./:])?(position|translation)")  # Metres, which it does not state
_STAMPED: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
}
_TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def table_poses(path: Path, text: str, error: type[MeasureError]) -> dict[str, TrackedBody] | None:
    """The body in a table of poses with telling headings; None if it is no such table, or ours."""
    dialect = Dialect.of(text)
    header = dialect.names
    if set(COLUMNS) <= set(header) or (stamps := time_columns(header)) is None:
        return None
    columns, units = dict[str, dict[str, int]](), dict[str, str]()
    for column, heading in enumerate(header):
        unit = _UNIT.search(heading.lower())
        name = heading.lower()[: unit.start() if unit else None]
        stem = name[:-1].rstrip("._/: ") if name[-1:] in (*"wxyz",) else name
        columns.setdefault(stem, {})[name[-1:]] = column
        units[stem] = (unit.group("unit") or unit.group("suffix") or "") if unit else ""
    turns = [at for at in columns.values() if {*"wxyz"} <= set(at)]
    places = [stem for stem, at in columns.items() if {*at} == {*"xyz"} and _PLACE.fullmatch(stem)]
    if len(turns) != 1 or len(places) != 1:
        return None
    unit_name = units[places[0]] or ("m" if _OF_ROS.fullmatch(places[0]) else "")
    if unit_name not in MM_PER:
        return None
    rows = [row for _, row in csv_rows(text, dialect.separator, error, str(path))]
    body = TrackedBody(
        rows,
        after=dialect.head - 1,
        times=[column for column, _ in stamps],
        units_s=[unit_s for _, unit_s in stamps],
        turns=[turns[0][axis] for axis in "wxyz"],
        quat_wxyz=np.asarray,
        places=[columns[places[0]][axis] for axis in "xyz"],
        unit_mm=MM_PER[unit_name],
    )
    return {path.stem: body}


def bag_poses(address: Path, _: str, error: type[MeasureError]) -> dict[str, TrackedBody] | None:
    """The bodies in a bag, by topic, or by child frame of `/tf`; None if it is no bag."""
    path, topic = split_topic(address)
    if not is_bag(path):
        return None
    found = dict[str, list[tuple[int, int, list[str]]]]()
    with open_bag(path, error) as bag:
        for name, stamps, pose in _poses(bag, topic):
            where = getattr(pose, "position", getattr(pose, "translation", None))
            turn = getattr(pose, "orientation", getattr(pose, "rotation", None))
            cells = [*(getattr(where, a) for a in "xyz"), *(getattr(turn, a) for a in "wxyz")]
            found.setdefault(name, []).append((*stamps, [*map(repr, map(float, cells))]))
        if not found:
            what = "no topic of poses" if topic is None else f"no topic {topic} of poses"
            kinds = ", ".join(kind.replace("/msg/", "/") for kind in (*_STAMPED, _TREES[0]))
            raise error(
                f"{address}: a bag with {what}: {kinds} are read; it has "
                f"{described(bag.connections)}"
            )
    return {
        name: TrackedBody(
            _rows(poses),
            after=-1,
            times=[0],
            units_s=[1e-9],
            turns=[4, 5, 6, 7],
            quat_wxyz=np.asarray,
            places=[1, 2, 3],
            unit_mm=MM_PER["m"],
        )
        for name, poses in found.items()
    }


def _rows(poses: list[tuple[int, int, list[str]]]) -> list[list[str]]:
    """Cells by stamp in ns, those of several publishers once; by receipt if none is stamped."""
    stamped = any(stamp for stamp, _, _ in poses)
    by_time = {stamp if stamped else received: cells for stamp, received, cells in poses}
    return [[str(time_ns), *by_time[time_ns]] for time_ns in sorted(by_time)]


def _poses(bag: Bag, topic: str | None) -> Iterator[tuple[str, tuple[int, int], Any]]:
    """Name, stamp and receipt in ns, and pose or transform, of all messages."""
    known = [c for c in bag.connections if c.msgtype in (*_STAMPED, *_TREES)]
    if topic is not None:
        known = [c for c in known if c.topic.strip("/") == topic.strip("/")]
    for one, received_ns, raw in bag.messages(known) if known else ():  # of none: of all
        message = bag.deserialize(raw, one.msgtype)
        parts = [(one.topic, message, _STAMPED.get(one.msgtype, lambda m: m)(message))]
        if one.msgtype in _TREES:
            parts = [(part.child_frame_id, part, part.transform) for part in message.transforms]
        for name, part, pose in parts:
            yield name, (stamp_ns(part.header, 0), received_ns), pose

"""States in ROS 1 bags, ROS 2 bags and MCAP files, without ROS.

RAVEN-II's are `raven_state` messages; other robots' joints are `sensor_msgs/JointState`, and their
tip is a `PoseStamped` or `TransformStamped` topic, comes from /tf, or is computed.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.reading import check_ordinary
from measure.robots.joint_topics import described, joint_rows
from measure.robots.pieces import PIECE_ROWS
from measure.robots.raven import FIELDS, raven_schema
from measure.robots.schema import StateSchema

MESSAGE = "raven_2/msg/raven_state"
# The message of the robot's public control software; ROS 2 has no `duration` word of its own.
DEFINITION = """
std_msgs/Header hdr
int32 runlevel
int32 sublevel
int32 last_seq
int32[2] type
int32[6] pos
float32[18] ori
float32[18] ori_d
int32[6] pos_d
builtin_interfaces/Duration dt
int32[16] encVals
int32[16] dac_val
float32[16] tau
float32[16] mpos
float32[16] jpos
float32[16] mvel
float32[16] jvel
float32[16] mpos_d
float32[16] jpos_d
float32[2] grasp_d
float32[16] encoffsets
float32[12] jac_vel
float32[12] jac_f
"""


def _rosbags() -> Any:
    try:
        import rosbags.highlevel
        import rosbags.typesys

        return rosbags
    except ImportError:
        raise EstimatorError(
            "reading bags needs the extra 'ros': pip install 'triball[ros]'"
        ) from None


def _types() -> Any:
    """Types of ROS 2; bags of ROS 1 bring their own."""
    typesys = _rosbags().typesys
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    store.register(typesys.get_types_from_msg(DEFINITION, MESSAGE))
    return store


def bag_pieces(
    path: Path, schema: StateSchema, topic: str | None = None
) -> Iterator[tuple[Floats, Floats]]:
    """States of one arm from a bag, piece by piece.

    Yields:
        Stamps (n,) from the message headers, in s, and states (n, features).

    Raises:
        EstimatorError: no or several topics hold the states, fields are missing, or a file that
            cannot be read.
    """
    if not path.is_dir():
        check_ordinary(path, EstimatorError)
    states = _bag_states(path, schema, topic)
    while some := list(itertools.islice(states, PIECE_ROWS)):
        times, rows = zip(*some, strict=True)
        yield np.array(times), np.array(rows)


def _bag_states(
    path: Path, schema: StateSchema, topic: str | None
) -> Iterator[tuple[float, Floats]]:
    arm = {raven_schema("left").robot: 0, raven_schema("right").robot: 1}.get(schema.robot)
    count = 0
    try:
        with _rosbags().highlevel.AnyReader([path], default_typestore=_types()) as reader:
            if arm is None:
                rows = joint_rows(path, reader, schema, topic)
            else:
                rows = _raven_rows(path, reader, arm, topic)
            for row in rows:
                yield row
                count += 1
    except EstimatorError:
        raise
    except Exception as error:  # rosbags raises many kinds; all mean the file
        hint = ": give the bag's folder" if path.suffix == ".db3" else ""
        raise EstimatorError(f"{path}: cannot be read as a bag: {error}{hint}") from None
    if not count:
        raise EstimatorError(f"{path}: holds no message of the robot's topic")


def _raven_rows(
    path: Path, reader: Any, arm: int, topic: str | None
) -> Iterator[tuple[float, Floats]]:
    found = [
        c
        for c in reader.connections
        if (c.topic == topic if topic else c.msgtype.lower().endswith("raven_state"))
    ]
    if len(found) != 1:
        raise EstimatorError(
            f"{path}: {len(found)} topics match {topic or 'raven_state'}; it has "
            f"{described(reader.connections)}: name one with --topic, or the robot with --robot"
        )
    for _, _, raw in reader.messages(connections=found):
        message = reader.deserialize(raw, found[0].msgtype)
        stamp = message.hdr.stamp
        yield stamp.sec + 1e-9 * stamp.nanosec, _row(path, message, arm)


def _row(path: Path, message: Any, arm: int) -> Floats:
    parts = []
    for field in FIELDS:
        values = getattr(message, field.name, None)
        if values is None or len(values) != 2 * field.per_arm:
            size = "no" if values is None else f"{len(values)} numbers in"
            raise EstimatorError(
                f"{path}: {size} field '{field.name}', expected {2 * field.per_arm}: "
                "the robot's software is older or newer than this schema"
            )
        parts.append(np.asarray(values)[arm * field.per_arm : (arm + 1) * field.per_arm])
    return np.concatenate(parts).astype(np.float64)

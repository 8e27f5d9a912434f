"""`raven_state` messages in ROS 1 bags, ROS 2 bags and MCAP files, without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.robots.raven import FIELDS, raven_schema
from measure.robots.schema import RobotLog, StateSchema

MESSAGE = "raven_2/msg/raven_state"
TOPIC = "/ravenstate"
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
{duration} dt
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
        import rosbags.rosbag1
        import rosbags.rosbag2
        import rosbags.typesys

        return rosbags
    except ImportError:
        raise EstimatorError(
            "reading and writing bags needs the extra 'ros': pip install 'triball[ros]'"
        ) from None


def _types(ros1: bool) -> Any:
    typesys = _rosbags().typesys
    store = typesys.get_typestore(
        typesys.Stores.ROS1_NOETIC if ros1 else typesys.Stores.ROS2_HUMBLE
    )
    text = DEFINITION.format(duration="duration" if ros1 else "builtin_interfaces/Duration")
    store.register(typesys.get_types_from_msg(text, MESSAGE))
    return store


def read_bag(path: Path, schema: StateSchema, topic: str | None = None) -> tuple[Floats, Floats]:
    """States of one arm from a bag.

    Returns:
        Stamps (n,) from the message headers, in s, and states (n, 118).

    Raises:
        EstimatorError: no or several topics of `raven_state`, fields missing, a schema that is not
            a RAVEN-II's, or a file that cannot be read.
    """
    arm = _arm(schema)
    if arm is None:
        raise EstimatorError(f"{path}: bags hold RAVEN-II states, not those of {schema.robot}")
    highlevel = _rosbags().highlevel
    times, rows = [], []
    try:
        with highlevel.AnyReader([path], default_typestore=_types(ros1=False)) as reader:
            connection = _choose(path, reader.connections, topic)
            for _, _, raw in reader.messages(connections=[connection]):
                message = reader.deserialize(raw, connection.msgtype)
                stamp = message.hdr.stamp
                times.append(stamp.sec + 1e-9 * stamp.nanosec)
                rows.append(_row(path, message, arm))
    except EstimatorError:
        raise
    except Exception as error:  # rosbags raises many kinds; all mean the file
        raise EstimatorError(f"{path}: cannot be read as a bag: {error}") from None
    if not rows:
        raise EstimatorError(f"{path}: holds no message of the topic {connection.topic}")
    return np.array(times), np.array(rows)


def write_bag(path: Path, log: RobotLog) -> None:
    """Write one arm's states as `raven_state` messages; the other arm's numbers are zero.

    Args:
        path: `.bag` (ROS 1), otherwise a ROS 2 folder: `NAME.mcap` in MCAP, else sqlite3.
        log: RAVEN-II states.

    Raises:
        EstimatorError: the states are not a RAVEN-II's.
    """
    arm = _arm(log.schema)
    if arm is None:
        raise EstimatorError(f"{path}: only RAVEN-II states can be written as raven_state messages")
    rosbags = _rosbags()
    ros1 = path.suffix == ".bag"
    types = _types(ros1)
    if ros1:
        writer = rosbags.rosbag1.Writer(path)
    else:
        storage = rosbags.rosbag2.StoragePlugin
        kind = storage.MCAP if path.suffix == ".mcap" else storage.SQLITE3
        writer = rosbags.rosbag2.Writer(path, version=9, storage_plugin=kind)
    with writer:
        connection = writer.add_connection(TOPIC, MESSAGE, typestore=types)
        for index, (time_s, state) in enumerate(zip(log.times_s, log.states, strict=True)):
            message = _message(types, index, float(time_s), state, arm, ros1)
            data = (types.serialize_ros1 if ros1 else types.serialize_cdr)(message, MESSAGE)
            writer.write(connection, round(time_s * 1e9), data)


def _arm(schema: StateSchema) -> int | None:
    names = {raven_schema("left").robot: 0, raven_schema("right").robot: 1}
    return names.get(schema.robot)


def _choose(path: Path, connections: list[Any], topic: str | None) -> Any:
    found = [
        c
        for c in connections
        if (c.topic == topic if topic else c.msgtype.lower().endswith("raven_state"))
    ]
    if len(found) != 1:
        seen = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in connections}))
        what = topic or "raven_state"
        raise EstimatorError(
            f"{path}: {len(found)} topics match {what}; it has {seen}: name one with --topic"
        )
    return found[0]


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


def _message(types: Any, index: int, time_s: float, state: Floats, arm: int, ros1: bool) -> Any:
    known = types.types
    seconds, nano = divmod(round(time_s * 1e9), 1_000_000_000)
    stamp = known["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nano)
    header = {"stamp": stamp, "frame_id": "0"} | ({"seq": index} if ros1 else {})
    values: dict[str, Any] = {}
    start = 0
    for field in FIELDS:
        both = np.zeros(2 * field.per_arm, dtype=np.int32 if field.integer else np.float32)
        both[arm * field.per_arm : (arm + 1) * field.per_arm] = state[start : start + field.per_arm]
        values[field.name] = both
        start += field.per_arm
    return known[MESSAGE](
        hdr=known["std_msgs/msg/Header"](**header),
        runlevel=3,
        sublevel=0,
        last_seq=index,
        dt=known["builtin_interfaces/msg/Duration"](sec=0, nanosec=1_000_000),
        **values,
    )

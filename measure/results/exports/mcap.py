"""MCAP with ROS 2 messages, as `ros2 bag` and Foxglove read it; metres and radians."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import RunError
from measure.results.pose_table import Velocities
from measure.results.run import Run
from measure.results.tables import numbers, texts

WORLD, BODY = "world", "body"
BALL_TOPIC, TF_TOPIC = "/balls", "/tf"
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
_POINT = "geometry_msgs/msg/PointStamped"
_TF = "tf2_msgs/msg/TFMessage"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_END_S = 2**31
_METRES = np.array([1e-3] * 3 + [1.0] * 3)


def write(runs: Sequence[Run], path: Path, velocities: Sequence[Velocities] = ()) -> None:
    """Write the poses with covariance, their transforms, every located ball, perhaps velocities.

    Topics and frame of one body are called `body`, those of several by their names.

    ROS orders a pose covariance as we do (x y z, then rotations about the fixed axes).
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        bag = Path(scratch) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            out = _Topics(writer, store)
            for k, run in enumerate(runs):
                body = _topic_name(run.body.name) if len(runs) > 1 else BODY
                _write_poses(run, out, body)
                _write_balls(run, out, f"/{body}{BALL_TOPIC}" if len(runs) > 1 else BALL_TOPIC)
                if velocities:
                    _write_velocities(run, velocities[k], out, body)
        next(bag.glob("*.mcap")).replace(path)


class _Topics:
    """Serialises messages and opens each topic when its first message comes."""

    def __init__(self, writer: Any, store: Any) -> None:
        self._writer, self._store, self._open = writer, store, {}  # type: ignore[var-annotated]

    def message(self, kind: str, values: Mapping[str, Any]) -> Any:
        """A message of a type such as "geometry_msgs/msg/Pose"; parts of it may be mappings too."""
        kinds = dict(self._store.get_msgdef(kind).fields)
        made = {
            name: self.message(kinds[name][1], value) if isinstance(value, Mapping) else value
            for name, value in values.items()
        }
        return self._store.types[kind](**made)

    def send(self, topic: str, kind: str, time_s: float, values: Mapping[str, Any]) -> None:
        """Append a message."""
        if topic not in self._open:
            self._open[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        data = self._store.serialize_cdr(self.message(kind, values), kind)
        self._writer.write(self._open[topic], _nanoseconds(time_s), data)


def _write_poses(run: Run, out: _Topics, body: str) -> None:
    poses = run.world_from_body
    quats, covariances = poses.quat_wxyz, run.covariances * np.outer(_METRES, _METRES)
    for k, time_s in enumerate(run.times_s[run.has_pose].tolist()):
        header, covariance = _header(time_s), covariances[k].reshape(36)
        place, turn = _letters("xyz", poses.translation[k] / 1000), _letters("wxyz", quats[k])
        pose = {"pose": {"position": place, "orientation": turn}, "covariance": covariance}
        out.send(f"/{body}/pose", _POSE, time_s, {"header": header, "pose": pose})
        moved = {"translation": place, "rotation": turn}
        frame = {"header": header, "child_frame_id": body, "transform": moved}
        out.send(TF_TOPIC, _TF, time_s, {"transforms": [out.message(_TRANSFORM, frame)]})


def _write_velocities(run: Run, velocities: Velocities, out: _Topics, body: str) -> None:
    values = velocities.values * _METRES
    spread = velocities.covariances * np.outer(_METRES, _METRES)
    for k in np.flatnonzero(np.isfinite(values).all(axis=1)).tolist():
        linear, angular = _letters("xyz", values[k, :3]), _letters("xyz", values[k, 3:])
        moving = {"twist": {"linear": linear, "angular": angular}}
        twist = moving | {"covariance": spread[k].reshape(36)}
        time_s = float(run.times_s[k])
        out.send(f"/{body}/twist", _TWIST, time_s, {"header": _header(time_s), "twist": twist})


def _write_balls(run: Run, out: _Topics, above: str) -> None:
    table = run.balls
    centers = numbers(table, "x_mm", "y_mm", "z_mm") / 1000
    times, names = numbers(table, "time_s"), texts(table, "ball")
    topics = _topics(run.body.names, above)
    for time_s, name, center in zip(times.tolist(), names.tolist(), centers, strict=True):
        point = {"header": _header(time_s), "point": _letters("xyz", center)}
        out.send(topics[name], _POINT, time_s, point)


def _header(time_s: float) -> dict[str, Any]:
    """A header in the world frame."""
    sec, nanosec = divmod(_nanoseconds(time_s), 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": WORLD}


def _letters(names: str, values: Floats) -> dict[str, float]:
    """Numbers that are called by single letters."""
    return dict(zip(names, values.tolist(), strict=True))


def _topics(balls: Sequence[str], above: str) -> dict[str, str]:
    """A topic for each ball; with the ball's number where ROS allows too little of its name."""
    words = [_topic_name(name) for name in balls]
    return {
        name: f"{above}/{word}" + (f"_{number}" if words.count(word) > 1 else "")
        for number, (name, word) in enumerate(zip(balls, words, strict=True))
    }


def _topic_name(name: str) -> str:
    """A ball's name as ROS allows it in a topic."""
    word = "".join(c if c.isalnum() and c.isascii() else "_" for c in name)
    return word if word[:1].isalpha() else f"ball_{word}"


def _nanoseconds(time_s: float) -> int:
    if not 0 <= time_s < _END_S:
        raise RunError(
            f"ROS knows no time {time_s:g} s, only those from 0 to {_END_S}: shift the session's "
            "clocks with time_offset_s, or export another format"
        )
    return round(time_s * 1e9)

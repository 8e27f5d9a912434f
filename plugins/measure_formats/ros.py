"""MCAP with ROS 2 messages, as `ros2 bag` and Foxglove read it; metres and radians."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from measure.host import plain_names
from measure.host.messages import METRES, POSE, RosMessages, header, letters, nanoseconds
from measure.results.pose_table import Velocities
from measure.results.run import Run
from measure.results.tables import numbers, texts

WORLD, BODY = "world", "body"
BALL_TOPIC, TF_TOPIC = "/balls", "/tf"
_TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
_POINT = "geometry_msgs/msg/PointStamped"


def write(runs: Sequence[Run], path: Path, velocities: Sequence[Velocities] = ()) -> None:
    """Write the poses with covariance, their transforms, every located ball, perhaps velocities.

    Topics and frame of one body are called `body`, those of several by their names.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        bag = Path(scratch) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            out = _Topics(writer)
            words = plain_names(run.body.name for run in runs)
            for k, run in enumerate(runs):
                body = words[run.body.name] if len(runs) > 1 else BODY
                _write_poses(run, out, body)
                _write_balls(run, out, f"/{body}{BALL_TOPIC}" if len(runs) > 1 else BALL_TOPIC)
                if velocities:
                    _write_velocities(run, velocities[k], out, body)
        next(bag.glob("*.mcap")).replace(path)


class _Topics:
    """Opens each topic when its first message comes."""

    def __init__(self, writer: Any) -> None:
        self._writer, self._open, self.messages = writer, dict[str, Any](), RosMessages()

    def send(self, topic: str, kind: str, time_s: float, values: Mapping[str, Any]) -> None:
        """Append a message."""
        self.append(topic, kind, time_s, self.messages.cdr(kind, values))

    def append(self, topic: str, kind: str, time_s: float, data: bytes) -> None:
        """Append a message that is serialised."""
        if topic not in self._open:
            store = self.messages.store
            self._open[topic] = self._writer.add_connection(topic, kind, typestore=store)
        self._writer.write(self._open[topic], nanoseconds(time_s), data)


def _write_poses(run: Run, out: _Topics, body: str) -> None:
    poses, covariances = run.world_from_body, run.covariances
    for k, time_s in enumerate(run.times_s[run.has_pose].tolist()):
        made = out.messages.poses(time_s, WORLD, body, poses[k], covariances[k])
        for kind, data in made:
            out.append(f"/{body}/pose" if kind == POSE else TF_TOPIC, kind, time_s, data)


def _write_velocities(run: Run, velocities: Velocities, out: _Topics, body: str) -> None:
    values = velocities.values * METRES
    spread = velocities.covariances * np.outer(METRES, METRES)
    for k in np.flatnonzero(np.isfinite(values).all(axis=1)).tolist():
        linear, angular = letters("xyz", values[k, :3]), letters("xyz", values[k, 3:])
        moving = {"twist": {"linear": linear, "angular": angular}}
        twist = moving | {"covariance": spread[k].reshape(36)}
        time_s = float(run.times_s[k])
        head = {"header": header(time_s, WORLD)}
        out.send(f"/{body}/twist", _TWIST, time_s, head | {"twist": twist})


def _write_balls(run: Run, out: _Topics, above: str) -> None:
    table = run.balls
    centers = numbers(table, "x_mm", "y_mm", "z_mm") / 1000
    times, names = numbers(table, "time_s"), texts(table, "ball")
    words = plain_names(run.body.names, "ball")
    for time_s, name, center in zip(times.tolist(), names.tolist(), centers, strict=True):
        point = {"header": header(time_s, WORLD), "point": letters("xyz", center)}
        out.send(f"{above}/{words[name]}", _POINT, time_s, point)

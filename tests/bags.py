"""Bags as recorders write them, of ROS 1 or 2, by `rosbags`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np

_NS = 10**9


class Bag:
    """A bag that is being written: of ROS 1 if it is kept as `.bag`, else a folder of ROS 2.

    Args:
        path: of the file, or of the folder.
        kept: `.bag`, `.mcap` or another ending, which is SQLite; the path's if omitted.
        definitions: of further messages, by kind.
    """

    def __init__(
        self, path: Path, kept: str = "", definitions: dict[str, str] | None = None
    ) -> None:
        from rosbags import rosbag1, rosbag2, typesys

        self.path, kept, stores = path, kept or path.suffix, typesys.Stores
        self.ros1 = kept == ".bag"
        self.store = typesys.get_typestore(stores.ROS1_NOETIC if self.ros1 else stores.ROS2_HUMBLE)
        for kind, text in (definitions or {}).items():
            self.store.register(typesys.get_types_from_msg(text, kind))
        plugin = rosbag2.StoragePlugin
        stored = plugin.MCAP if kept == ".mcap" else plugin.SQLITE3
        self._writer: Any = (
            rosbag1.Writer(path)
            if self.ros1
            else rosbag2.Writer(path, version=9, storage_plugin=stored)
        )
        self._topics: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, *problem: object) -> None:
        self._writer.close()

    def make(self, kind: str, **fields: Any) -> Any:
        """A message, or a part of one."""
        package, _, name = kind.partition("/")
        return self.store.types[f"{package}/msg/{name}"](**fields)

    def header(self, time_s: float, frame: str = "") -> Any:
        """Exact to the nanosecond also where times count from 1970."""
        ns = _in_ns(time_s)
        stamp = self.make("builtin_interfaces/Time", sec=ns // _NS, nanosec=ns % _NS)
        seq = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame, **seq)

    def send(self, topic: str, kind: str, received_s: float, **fields: Any) -> None:
        """Write a message."""
        name = kind.replace("/", "/msg/")
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, name, typestore=self.store)
        pack = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        data = pack(self.make(kind, **fields), name)
        self._writer.write(self._topics[topic], _in_ns(received_s), data)

    def joints(self, topic: str, time_s: float, names: Any, values: Any) -> None:
        """Write positions of joints."""
        none, header = np.zeros(0), self.header(time_s)
        state = {"name": list(names), "position": np.array(values), "velocity": none}
        self.send(topic, "sensor_msgs/JointState", time_s, header=header, effort=none, **state)


def _in_ns(time_s: float) -> int:
    whole = int(time_s)
    return whole * _NS + round((time_s - whole) * 1e9)

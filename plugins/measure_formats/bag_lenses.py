"""Lenses that topics of `camera_info` in bags of ROS state."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.bags import Bag, described, open_bag, split_topic
from measure.errors import CalibrationError
from measure.session import StatedCamera, StatedRig, stated_model

_INFO = "sensor_msgs/msg/CameraInfo"


def read_camera_infos(address: Path) -> StatedRig:
    """The lenses that a bag's topics of `camera_info` state; CalibrationError if none does."""
    path, topic = split_topic(address)
    with open_bag(path, CalibrationError) as bag:
        there = sorted({one.topic for one in bag.connections if one.msgtype == _INFO})
        wanted = [t for t in there if topic is None or t.strip("/") == topic.strip("/")]
        infos = {t: info for t in wanted if (info := _info(bag, t)) is not None}
        if not infos:
            which = f"no topic {topic}" if topic is not None else "no camera_info of a known lens"
            raise CalibrationError(f"{address}: {which}; it has {described(bag.connections)}")
    cameras = [_stated(f"{path}: {t}", _named(t, infos), info) for t, info in infos.items()]
    return StatedRig("ROS", tuple(cameras), "m")


def _info(bag: Bag, topic: str) -> Any | None:
    """The first message of a topic that states a lens; drivers without one send zeros."""
    for connection, _, raw in bag.messages([c for c in bag.connections if c.topic == topic]):
        info = bag.deserialize(raw, connection.msgtype)
        return info if np.any(_k(info)) else None
    return None


def _k(info: Any) -> Floats:
    return np.asarray(getattr(info, "k", getattr(info, "K", None)), dtype=np.float64)


def _named(topic: str, among: Iterable[str]) -> str:
    """`/rig/left/camera_info` is that of "left", if no other is."""
    parts = topic.strip("/").split("/")[:-1] or ["camera"]
    same = [one for one in among if one.strip("/").split("/")[:-1][-1:] == parts[-1:]]
    return parts[-1] if len(same) < 2 else "/".join(parts)


def _stated(place: str, name: str, info: Any) -> StatedCamera:
    roi = info.roi
    if max(info.binning_x, info.binning_y) > 1 or roi.x_offset or roi.y_offset:
        raise CalibrationError(
            f"{place}: is of pictures that are binned or cut out (binning, roi): give the lens of "
            "the pictures as they were recorded"
        )
    distortion = np.asarray(getattr(info, "d", getattr(info, "D", ())), dtype=np.float64)
    return StatedCamera(
        name,
        _k(info).reshape(3, 3),
        distortion,
        stated_model(place, {"distortion_model": info.distortion_model}),
        (int(info.width), int(info.height)),
    )

"""The sink `foxglove`: a live connection of Foxglove, with transforms, poses and pictures."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import cv2

from measure.host import (
    EventMark,
    SentPose,
    Settings,
    Sink,
    hookimpl,
    host_port,
    needed,
    plain_names,
    setting,
)
from measure.model import Image

_TCP = socket.AF_INET, socket.SOCK_STREAM


class FoxgloveSettings(Settings):
    """Settings of the `foxglove` sink."""

    picture_width_px: int = setting(320, "Width of the pictures that are sent.", unit="px", ge=16)
    picture_rate_hz: float = setting(5.0, "Pictures a second at most.", unit="Hz", gt=0)
    backlog: int = setting(256, "Messages held for a client; of more the oldest are lost.", ge=1)


class FoxgloveSink(Sink):
    """A WebSocket server for Foxglove: /tf in metres, a topic for each body, pictures, marks.

    Clients that do not keep up lose messages, uncounted.
    """

    name = "foxglove"
    form = "foxglove://HOST:PORT"
    takes_pictures = True
    Config = FoxgloveSettings
    config: FoxgloveSettings

    def prepare(self) -> None:
        """Read the address and load the libraries."""
        self._place = dict(zip(("host", "port"), host_port(self.address, 8765), strict=True))
        self._foxglove = needed("foxglove", "foxglove")
        # Its lines would stand between ours; only the first call has an effect.
        self._foxglove.set_log_level("CRITICAL")
        self._words = plain_names(body.name for body in self.run.bodies)
        self._messages = needed("foxglove.messages", "foxglove")
        self._channels = needed("foxglove.channels", "foxglove")
        self._server: Any = None
        self._topics: dict[str, Any] = {}
        self._pictured_s = -math.inf

    def open(self) -> None:
        """Listen."""
        make, kinds = self._foxglove.Channel, self._channels
        self._context = context = self._foxglove.Context()  # channels live as long as it
        known = {"message_backlog_size": self.config.backlog, "context": context}
        self._server = self._start(self._place | known)
        self._send_at_once()
        made = [make(self._topic(*stream), context=context) for stream in self.run.streams]
        made += [kinds.FrameTransformChannel("/tf", context=context)]
        made += [kinds.LogChannel("/marks", context=context)]
        for camera in self.run.cameras:
            made += [kinds.CompressedImageChannel(f"/{camera.name}/image", context=context)]
        self._topics = {one.topic(): one for one in made}

    def _start(self, options: Mapping[str, Any]) -> Any:
        """A server; that of an earlier opening frees its port a little after it was stopped."""
        for _ in range(10):
            with suppress(RuntimeError):
                return self._foxglove.start_server(name=self.run.name, **options)
            time.sleep(0.1)
        return self._foxglove.start_server(name=self.run.name, **options)

    def _send_at_once(self) -> None:
        """Turn off Nagle's algorithm, which holds every third message back for 40 ms.

        Connections take that over from the socket that listens; the library hands out neither.
        """
        with suppress(OSError):  # where open files are not listed
            for number in os.listdir("/dev/fd"):  # noqa: PTH208 -- some are gone by now
                with suppress(OSError), socket.fromfd(int(number), *_TCP) as one:
                    if one.getsockname()[1:2] == (self._server.port,):
                        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, pose: SentPose) -> None:
        """The columns of the pose, and its transform if there is one."""
        topic = self._topic(pose.body, pose.reference)
        self._log(topic, pose.exposed_s, pose.plain())
        if pose.pose is None:
            return
        x, y, z = (pose.pose.world_from_body.translation / 1000).tolist()
        qw, qx, qy, qz = pose.pose.world_from_body.quat_wxyz.tolist()
        transform = self._messages.FrameTransform(
            timestamp=self._stamp(pose.exposed_s),
            parent_frame_id=pose.reference or "world",
            # A frame has one parent: the body's own is the world.
            child_frame_id=" in ".join(filter(None, (pose.body, pose.reference))),
            translation=self._messages.Vector3(x=x, y=y, z=z),
            rotation=self._messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
        )
        self._log("/tf", pose.exposed_s, transform)

    def send_mark(self, mark: EventMark) -> None:
        """A line of the log."""
        line = self._messages.Log(timestamp=self._stamp(mark.marked_s), message=mark.text)
        self._log("/marks", mark.marked_s, line)

    def send_pictures(self, images: Mapping[str, Image]) -> None:
        """Small pictures, if their turn has come."""
        time_s = max((image.time_s for image in images.values()), default=-math.inf)
        if time_s - self._pictured_s < 1 / self.config.picture_rate_hz:
            return
        self._pictured_s, width_px = time_s, self.config.picture_width_px
        for name, image in images.items():
            height, width = image.pixels.shape[:2]
            size = width_px, max(width_px * height // width, 1)
            jpeg = cv2.imencode(".jpg", cv2.resize(image.pixels, size))[1].tobytes()
            known = {"timestamp": self._stamp(image.time_s), "frame_id": name, "format": "jpeg"}
            picture = self._messages.CompressedImage(data=jpeg, **known)
            self._log(f"/{name}/image", image.time_s, picture)

    def close(self) -> None:
        """End the connections."""
        if self._server is not None:
            self._server.stop()
        self._server = None

    def _log(self, topic: str, time_s: float, message: Any) -> None:
        if topic in self._topics:
            self._topics[topic].log(message, log_time=round(time_s * 1e9))

    def _stamp(self, time_s: float) -> Any:
        return self._messages.Timestamp(*divmod(round(time_s * 1e9), 10**9))

    def _topic(self, body: str, reference: str) -> str:
        """The topic of a kind of pose; bodies have plain names in it."""
        return "/" + "/".join(self._words.get(one, one) for one in (body, reference) if one)


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `foxglove`."""
    return [FoxgloveSink]

"""The sink `foxglove`: a live connection of Foxglove, with transforms, poses and pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import cv2

from measure.host import EventMark, SentPose, Settings, Sink, hookimpl, host_port, needed, setting
from measure.model import Image


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
        self._place = host_port(self.address)
        self._foxglove = needed("foxglove", "foxglove")
        self._messages = needed("foxglove.messages", "foxglove")
        self._channels = needed("foxglove.channels", "foxglove")
        self._server: Any = None
        self._context: Any = None
        self._topics: dict[str, Any] = {}
        self._pictured_s = -math.inf

    def open(self) -> None:
        """Listen."""
        host, port = self._place
        self._topics, self._context = {}, self._foxglove.Context()
        self._server = self._foxglove.start_server(
            name=f"triball {self.run.name}",
            host=host,
            port=port,
            message_backlog_size=self.config.backlog,
            context=self._context,
        )
        for body, reference in self.run.streams:
            self._topic(_topic(body, reference), self._foxglove.Channel)
        self._topic("/tf", self._channels.FrameTransformChannel)
        self._topic("/marks", self._channels.LogChannel)

    def send(self, pose: SentPose) -> None:
        """The columns of the pose, and its transform if there is one."""
        topic = _topic(pose.body, pose.reference)
        self._log(topic, self._foxglove.Channel, pose.exposed_s, pose.plain())
        if pose.pose is None:
            return
        x, y, z = (pose.pose.world_from_body.translation / 1000).tolist()
        qw, qx, qy, qz = pose.pose.world_from_body.quat_wxyz.tolist()
        transform = self._messages.FrameTransform(
            timestamp=self._stamp(pose.exposed_s),
            parent_frame_id=pose.reference or "world",
            # A frame has one parent: the body's own is the world.
            child_frame_id=topic.strip("/").replace("/", " in "),
            translation=self._messages.Vector3(x=x, y=y, z=z),
            rotation=self._messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
        )
        self._log("/tf", self._channels.FrameTransformChannel, pose.exposed_s, transform)

    def send_mark(self, mark: EventMark) -> None:
        """A line of the log."""
        stamp, level = self._stamp(mark.marked_s), self._messages.LogLevel.Info
        line = self._messages.Log(timestamp=stamp, level=level, message=mark.text, name="mark")
        self._log("/marks", self._channels.LogChannel, mark.marked_s, line)

    def send_pictures(self, images: Mapping[str, Image]) -> None:
        """Small pictures, if their turn has come."""
        if not images:
            return
        time_s = next(iter(images.values())).time_s
        if time_s - self._pictured_s < 1 / self.config.picture_rate_hz:
            return
        self._pictured_s = time_s
        for name, image in images.items():
            height, width = image.pixels.shape[:2]
            size = self.config.picture_width_px, self.config.picture_width_px * height // width
            small = cv2.resize(image.pixels, size, interpolation=cv2.INTER_AREA)
            picture = self._messages.CompressedImage(
                timestamp=self._stamp(image.time_s),
                frame_id=name,
                data=cv2.imencode(".jpg", small)[1].tobytes(),
                format="jpeg",
            )
            kind = self._channels.CompressedImageChannel
            self._log(f"/{name}/image", kind, image.time_s, picture)

    def close(self) -> None:
        """End the connections."""
        if self._server is not None:
            self._server.stop()
        self._server = None

    def _topic(self, topic: str, kind: Any) -> Any:
        """A topic, which clients see from its first use on."""
        if topic not in self._topics:
            self._topics[topic] = kind(topic, context=self._context)
        return self._topics[topic]

    def _log(self, topic: str, kind: Any, time_s: float, message: Any) -> None:
        self._topic(topic, kind).log(message, log_time=round(time_s * 1e9))

    def _stamp(self, time_s: float) -> Any:
        return self._messages.Timestamp(*divmod(round(time_s * 1e9), 10**9))


def _topic(body: str, reference: str) -> str:
    return "/" + "/".join(filter(None, (body, reference)))


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `foxglove`."""
    return [FoxgloveSink]

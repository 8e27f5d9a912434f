"""The sink `zenoh`: messages of ROS 2 on the keys that zenoh-bridge-ros2dds passes on."""

from __future__ import annotations

from typing import Any

from measure.errors import ConfigError
from measure.host import (
    SentPose,
    Settings,
    Sink,
    hookimpl,
    needed,
    plain_name,
    plain_names,
    setting,
)
from measure.host.messages import POSE, RosMessages

_DROP = "transport/link/tx/queue/congestion_control/drop"  # In the configuration of Zenoh


class ZenohSettings(Settings):
    """Settings of the `zenoh` sink."""

    connect: str = setting("", "Where to connect, as tcp/HOST:7447; empty: look around for peers.")
    world: str = setting("world", "Name of the world's frame.")
    tf_key: str = setting("tf", "Key of the transforms, which ROS expects in /tf.")


class ZenohSink(Sink):
    """PoseWithCovarianceStamped on KEY/BODY/pose and TFMessage on tf, in metres, as CDR.

    Frame sets without a pose are not sent. Who does not keep up loses messages, uncounted.
    """

    name = "zenoh"
    form = "zenoh:KEY"
    Config = ZenohSettings
    config: ZenohSettings

    def prepare(self) -> None:
        """Read the address and load the libraries."""
        self._zenoh = needed("zenoh", "zenoh")
        needed("rosbags", "zenoh")
        self._key = self.address.strip("/")
        if not self._key or set("*$?#") & set(self._key):
            raise ConfigError("expected a key such as triball")
        self._messages = RosMessages()
        self._words = plain_names(body.name for body in self.run.bodies)
        self._session: Any = None
        self._publishers: dict[str, Any] = {}

    def open(self) -> None:
        """Join the network of Zenoh."""
        config = self._zenoh.Config()
        # A receiver that is slow loses messages, but not for a busy moment of this machine.
        config.insert_json5(f"{_DROP}/wait_before_drop", "50000")
        config.insert_json5("connect/retry", '{"period_init_ms": 500, "period_max_ms": 1000}')
        if self.config.connect:
            config.insert_json5("connect/endpoints", f'["{self.config.connect}"]')
            config.insert_json5("scouting/multicast/enabled", "false")
        self._session = self._zenoh.open(config)

    def send(self, pose: SentPose) -> None:
        """The pose and its transform, if there is one."""
        if pose.pose is None:
            return
        body = self._words.get(pose.body) or plain_name(pose.body)
        world = plain_name(self.config.world, "world")
        reference = self._words.get(pose.reference, world)
        # A frame has one parent: the body's own is the world.
        child = f"{body}_in_{reference}" if pose.reference else body
        place, covariance = pose.pose.world_from_body, pose.pose.covariance
        made = self._messages.poses(pose.exposed_s, reference, child, place, covariance)
        for kind, data in made:
            key = f"{self._key}/{child}/pose" if kind == POSE else self.config.tf_key
            if key not in self._publishers:
                self._publishers[key] = self._session.declare_publisher(key, express=True)
            self._publishers[key].put(data)

    def close(self) -> None:
        """Leave the network."""
        if self._session is not None:
            self._session.close()
        self._session, self._publishers = None, {}


@hookimpl
def measure_sinks() -> list[type[Sink]]:
    """Register `zenoh`."""
    return [ZenohSink]

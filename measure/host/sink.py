"""The interface of sinks: what poses are sent to as soon as they are known."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from measure.errors import ConfigError
from measure.host.interfaces import Plugin
from measure.host.settings import Settings
from measure.model import Body, Camera, Image, Pose

PLACE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""The columns of a pose; the first three are those of any place."""
QUALITY = ("position_sd_mm", "rotation_sd_deg", "residual_mm", "rms_px")
"""Those that say how good it is."""


@dataclass(frozen=True, eq=False, slots=True)
class SentPose:
    """A body's pose of one frame set as a sink gets it, or that there is none."""

    body: str  # the body's name
    reference: str  # name of the body whose frame the pose is in; empty for the world
    frame: int  # number of the frame set
    time_s: float  # the instant that the pose holds for, on the run's clock
    # the same instant in seconds since 1970, on this machine's clock; of a run that is played, the
    # time of its turn.
    exposed_s: float
    known_s: float  # when the pose was known, in seconds since 1970
    status: str  # ok, flagged, lost or skipped
    reason: str  # why it is not ok; empty otherwise
    # the pose; its `world_from_body` is reference_from_body where there is a reference.
    pose: Pose | None

    def plain(self) -> dict[str, Any]:
        """All of it as JSON knows it, by the names of `poses.parquet`; null for NaN."""
        names = ("body", "reference", "time_s", "exposed_s", "known_s", "status", "reason")
        values = {"frame": self.frame, **{name: getattr(self, name) for name in names}}
        values |= {"cameras": (), "balls": (), "flags": (), **pose_columns(self.pose)}
        return {name: _plain(value) for name, value in values.items()}


@dataclass(frozen=True, slots=True)
class EventMark:
    """An event that the lab reported while a run was measured."""

    time_s: float  # when, on the run's clock
    marked_s: float  # the same in seconds since 1970, as `SentPose.exposed_s`
    text: str  # what


@dataclass(frozen=True, eq=False)
class SentRun:
    """The run that poses are sent of."""

    name: str  # of the run
    bodies: tuple[Body, ...]  # what is measured
    cameras: tuple[Camera, ...]  # as calibrated
    # name of the body that the others are also sent relative to; empty without one.
    reference: str = ""

    @property
    def streams(self) -> list[tuple[str, str]]:
        """`body` and `reference` of every kind of pose that is sent."""
        names = [body.name for body in self.bodies]
        relative = [(n, self.reference) for n in names if self.reference and n != self.reference]
        return [(name, "") for name in names] + relative


class Sink(Plugin):
    """Sends poses on; used by one thread of its own, which may wait for nobody but itself.

    An exception is reported in one line; the sink is then closed, and opened again a second later.

    Attributes:
        form: how its address is typed after `--send`, such as `udp://HOST:PORT`.
        takes_pictures: whether `send_pictures` is called.
        config: its settings.
        address: what was typed, without the scheme.
        run: what is sent.
        notes: lines for the user about what is sent, made by `prepare`.
        undelivered: how many poses it took and could not hand to every receiver.
    """

    form: ClassVar[str]
    takes_pictures: ClassVar[bool] = False

    def __init__(self, config: Settings, address: str, run: SentRun) -> None:
        self.config, self.address, self.run = config, address, run
        self.undelivered, self.notes = 0, list[str]()
        self.prepare()

    @abstractmethod
    def prepare(self) -> None:
        """Read the address and load libraries; ConfigError: it is none, or one is missing."""

    def open(self) -> None:
        """Connect, or listen for receivers."""

    @abstractmethod
    def send(self, pose: SentPose) -> None:
        """Send a pose, or that there is none."""

    def send_mark(self, mark: EventMark) -> None:
        """Send an event mark."""

    def send_pictures(self, images: Mapping[str, Image]) -> None:
        """Send the pictures of a frame set, by camera, when there is time."""

    def close(self) -> None:
        """Disconnect; whether it was opened or not."""


def pose_columns(pose: Pose | None) -> dict[str, Any]:
    """A pose as columns of `poses.parquet`; NaN without one."""
    if pose is None:
        return dict.fromkeys((*PLACE, *QUALITY), float("nan"))
    place = (*pose.world_from_body.translation, *pose.world_from_body.quat_wxyz)
    return {
        **dict(zip(PLACE, map(float, place), strict=True)),
        "covariance": pose.covariance.ravel(),
        "position_sd_mm": pose.position_sd_mm,
        "rotation_sd_deg": pose.rotation_sd_deg,
        "residual_mm": float(pose.residual_mm),
        "rms_px": float(pose.rms_px),
        "cameras": pose.cameras,
        "balls": pose.balls,
        "flags": pose.flags,
    }


def _plain(value: Any) -> Any:
    """What JSON knows; no digits that mean nothing."""
    if isinstance(value, float):
        return float(f"{value:.9f}") if math.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [float(f"{one:.6g}") if isinstance(one, float) else one for one in value]
    return _plain(value.tolist()) if hasattr(value, "tolist") else value


def host_port(address: str, usual: int = 0) -> tuple[str, int]:
    """Read HOST:PORT; ConfigError for anything else.

    With a `usual` port, HOST alone has that, and nothing at all is 127.0.0.1.
    """
    if usual and (not address or address.endswith("]") or ":" not in address):
        address = f"{address or '127.0.0.1'}:{usual}"
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 65_536):
        raise ConfigError("expected HOST:PORT, such as 127.0.0.1:5005")
    return host.strip("[]"), int(port)

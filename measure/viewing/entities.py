"""Where everything stands in a Rerun recording, in which colour, and how it is sent there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sized
from itertools import chain
from typing import Any, Protocol

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from measure.arrays import Bools, Floats
from measure.limits import SINCE_1970_S

WORLD = "world"
BODY = "world/body"
TRAIL = "world/trail"
UNCERTAINTY = "world/uncertainty"
STATUS = "status"
TIMELINE_FRAME = "frame"
TIMELINE_TIME = "time"

ERROR_COLORS = {"x": (229, 83, 83), "y": (96, 180, 90), "z": (80, 130, 235), "3d": (240, 200, 60)}
ERROR_AXES = tuple(ERROR_COLORS)
_NAMED_COLORS = {
    "red": (214, 40, 40),
    "orange": (244, 140, 30),
    "yellow": (240, 200, 40),
    "green": (50, 160, 70),
    "cyan": (60, 190, 200),
    "blue": (50, 100, 220),
    "purple": (130, 70, 180),
    "magenta": (210, 60, 160),
    "pink": (240, 130, 180),
    "white": (235, 235, 235),
    "black": (60, 60, 60),
}
_PALETTE = ((50, 160, 70), (240, 200, 40), (214, 40, 40), (50, 100, 220), (130, 70, 180))
_LINES = (
    (61, 139, 212), (217, 130, 43), (79, 163, 90), (176, 95, 196),
    (201, 79, 109), (43, 163, 163), (138, 122, 61), (122, 134, 217),
)  # fmt: skip

# Of the names below, each is a function that puts in what it is called by.
camera = "world/cameras/{}".format  # A camera's pinhole and pose
image = "world/cameras/{}/image".format  # A camera's picture
centers = "world/cameras/{}/image/centers".format  # Detected centres in a camera's picture
outlines = "world/cameras/{}/image/outlines".format
"""Detected circles in a camera's picture, in the colour of their state."""
edges = "world/cameras/{}/image/edges".format
"""Outline points the detector measured in a camera's picture."""
suspended = "world/cameras/{}/image/suspended".format
"""Balls that are not used in a camera's picture, with the reason."""
ball = "world/balls/{}".format  # A ball's position
rays = "world/rays/{}".format  # The rays of a ball's effective detections
residual = "plots/residual_px/{}".format  # RMS reprojection residual of a camera
distance = "plots/distance_mm/{}-{}".format
"""Measured minus nominal distance of two balls, the first and the second."""
error = "plots/error_mm/{}".format  # Position error against truth: x, y, z or 3d
robot = "robot/{}".format  # The tip's way as reported by the robot, measured, or corrected
robot_position = "plots/robot_mm/{}/{}".format  # One coordinate of it: by axis and kind
robot_error = "plots/robot_error_mm/{}".format
"""Distance of the reported or corrected position from the measured one."""
CORRECTED_SD = "plots/correction/sd_mm"
UNFAMILIAR = "plots/correction/unfamiliar"
position = "plots/position_mm/{}".format  # The body's position in the world: x, y or z
rotation = "plots/rotation_deg/{}".format
"""How far the body is turned since the run's first pose, as a rotation vector: x, y or z."""
ROTATION_ERROR = "plots/error_deg/rotation"
POSITION_SD = "plots/position_sd_mm/3d"
EFFECTIVE_CAMERAS = "plots/effective_cameras/count"


def suffix(body: str, several: bool) -> str:
    """What the entities of one of several bodies end with; nothing if there is only one."""
    return f"/{rr.escape_entity_path_part(body)}" if several else ""


def ball_color(name: str, index: int) -> tuple[int, int, int]:
    """RGB for a ball whose colour is called `name`; a palette serves colours given as samples."""
    return _NAMED_COLORS.get(name.lower(), _PALETTE[index % len(_PALETTE)])


def line_color(index: int) -> tuple[int, int, int]:
    """RGB for the n-th of several traces."""
    return _LINES[index % len(_LINES)]


class Stream(Protocol):
    """What takes a recording: one of Rerun's, or a `ViewerFeed`."""

    def log(self, entity_path: str, entity: Any, /, *extra: Any, static: bool = False) -> None:
        """Log what happens at the time that is set, or what holds always."""

    def send_columns(
        self, entity_path: str, /, indexes: Iterable[Any], columns: Iterable[Any]
    ) -> None:
        """Send the values of several instants."""

    @property
    def set_time(self) -> Callable[..., None]:
        """Set the time of what is logged next."""


class FrameSetBatch:
    """One batch on both timelines; `suffix` ends every entity, see `suffix`."""

    def __init__(
        self, stream: Stream, frames: ArrayLike, times_s: ArrayLike, suffix: str = ""
    ) -> None:
        self._stream, self.suffix = stream, suffix
        self._frames = np.asarray(frames, dtype=np.int64)
        self.times_s = np.asarray(times_s, dtype=np.float64)
        self._index = self._on_timelines(np.ones(len(self._frames), dtype=bool))

    def send(self, entity: str, *columns: Iterable[Any], rows: Bools | None = None) -> None:
        """Send one entity's components, for all frame sets or for some rows (n,) of them."""
        index = self._index if rows is None else self._on_timelines(rows)
        self._stream.send_columns(
            entity + self.suffix, indexes=index, columns=list(chain(*columns))
        )

    def scalars(self, entity: str, values: Floats, rows: Bools | None = None) -> None:
        """Send numbers, one per row; NaN leaves a gap in the plot."""
        self.send(entity, rr.Scalars.columns(scalars=values), rows=rows)

    def _on_timelines(self, rows: Bools) -> list[rr.TimeColumn]:
        times_s = self.times_s[rows]
        dated = len(times_s) and times_s[0] >= SINCE_1970_S
        return [
            rr.TimeColumn(TIMELINE_FRAME, sequence=self._frames[rows]),
            rr.TimeColumn(TIMELINE_TIME, timestamp=times_s)
            if dated
            else rr.TimeColumn(TIMELINE_TIME, duration=times_s),
        ]


def lengths(rows: Iterable[Sized]) -> list[int]:
    """How many instances each row has, as `partition` wants it."""
    return [len(row) for row in rows]


def points(rows: Iterable[Any], width: int) -> Floats:
    """Coordinates (n, width) from any number of arrays of them, possibly none."""
    return np.concatenate([*rows, np.zeros((0, width))], axis=None).reshape(-1, width)


def set_time(stream: Stream, time_s: float) -> None:
    """The time of what is logged next: as a date where it is one, else as time since the start."""
    if time_s >= SINCE_1970_S:
        stream.set_time(TIMELINE_TIME, timestamp=time_s)
    else:
        stream.set_time(TIMELINE_TIME, duration=time_s)

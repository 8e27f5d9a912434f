"""Where everything stands in a Rerun recording, and in which colour: the one list of names."""

from __future__ import annotations

import rerun as rr

WORLD = "world"
BODY = "world/body"
TRAIL = "world/trail"
UNCERTAINTY = "world/uncertainty_x100"
UNCERTAINTY_SCALE = 100.0
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

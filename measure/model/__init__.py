"""Bodies, cameras, and what was seen: detections, positions of balls, and poses."""

from measure.model.body import Ball, Body, paper_body
from measure.model.camera import Camera, Intrinsics, Projection
from measure.model.color import BallColor, ColorRange, ConvertedImage
from measure.model.frames import FrameSet, Image
from measure.model.motion import Motion
from measure.model.observations import (
    BallPosition,
    BallView,
    Detection,
    Expectation,
    Pose,
    Reason,
    State,
)
from measure.model.rig import Rig, RigRows
from measure.model.rig_fit import (
    BoardObservation,
    CameraFit,
    MarkerObservation,
    RigFit,
    RigObservations,
    Tolerances,
)

__all__ = [
    "Ball", "BallColor", "BallPosition", "BallView", "BoardObservation", "Body", "Camera",
    "CameraFit", "ColorRange", "ConvertedImage", "Detection", "Expectation", "FrameSet", "Image",
    "Intrinsics", "MarkerObservation", "Motion", "Pose", "Projection", "Reason", "Rig", "RigFit",
    "RigObservations", "RigRows", "State", "Tolerances", "paper_body",
]  # fmt: skip

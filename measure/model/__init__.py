"""Bodies, cameras, and what was seen: detections, positions of balls, and poses."""

from measure.model.body import Ball, BallColor, Body, ColorRange, ConvertedImage, paper_body
from measure.model.camera import Camera, Intrinsics, Rig
from measure.model.camera_rows import Projection, RigRows
from measure.model.doubts import Doubt
from measure.model.observations import (
    BallPosition,
    BallView,
    Detection,
    Expectation,
    FrameSet,
    Image,
    Motion,
    Pose,
    Reason,
    State,
)
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
    "CameraFit", "ColorRange", "ConvertedImage", "Detection", "Doubt", "Expectation", "FrameSet",
    "Image", "Intrinsics", "MarkerObservation", "Motion", "Pose", "Projection", "Reason", "Rig",
    "RigFit", "RigObservations", "RigRows", "State", "Tolerances", "paper_body",
]  # fmt: skip

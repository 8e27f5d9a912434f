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

__all__ = [
    "Ball", "BallColor", "BallPosition", "BallView", "Body", "Camera", "ColorRange",
    "ConvertedImage", "Detection", "Expectation", "FrameSet", "Image", "Intrinsics", "Motion",
    "Pose", "Projection", "Reason", "Rig", "RigRows", "State", "paper_body",
]  # fmt: skip

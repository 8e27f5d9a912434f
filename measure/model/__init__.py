"""What is measured (body), with what (cameras), and what was seen (detections, fixes, poses)."""

from measure.model.body import Ball, Body
from measure.model.camera import Camera, Intrinsics
from measure.model.color import BallColor, ColorRange, ConvertedImage
from measure.model.frames import FrameSet, Image
from measure.model.motion import Motion
from measure.model.observations import BallView, Detection, Expectation, Fix, Pose
from measure.model.rig import Rig

__all__ = [
    "Ball",
    "BallColor",
    "BallView",
    "Body",
    "Camera",
    "ColorRange",
    "ConvertedImage",
    "Detection",
    "Expectation",
    "Fix",
    "FrameSet",
    "Image",
    "Intrinsics",
    "Motion",
    "Pose",
    "Rig",
]

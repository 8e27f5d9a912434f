"""Rendered scenes of balls with exact ground truth."""

from measure.simulation.recording import write_session
from measure.simulation.renderer import Renderer, render
from measure.simulation.scene import (
    Actor,
    Capsule,
    ContinuousTrajectory,
    Cuboid,
    Lamp,
    Lighting,
    Material,
    MotionLimits,
    Scene,
    Sines,
    Sphere,
    Still,
    random_motion,
)
from measure.simulation.sensor import CameraSensor

__all__ = [
    "Actor", "CameraSensor", "Capsule", "ContinuousTrajectory", "Cuboid", "Lamp", "Lighting",
    "Material", "MotionLimits", "Renderer", "Scene", "Sines", "Sphere", "Still", "random_motion",
    "render", "write_session",
]  # fmt: skip

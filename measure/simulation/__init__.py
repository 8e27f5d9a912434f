"""Ball scenes with exact truth: pictures of rigs that never existed."""

from measure.simulation.boards import Chessboard, Print, charuco
from measure.simulation.capture import CaptureScene, write_capture
from measure.simulation.catalogue import relit_scenes, scene_catalogue
from measure.simulation.observations import Observation, simulate_observations
from measure.simulation.recording import write_session
from measure.simulation.renderer import Renderer, render
from measure.simulation.scene import Actor, Scene
from measure.simulation.sensor import Sensor
from measure.simulation.shading import Light, Lighting, Material
from measure.simulation.shapes import Box, Capsule, Sphere
from measure.simulation.trajectory import MotionLimits, Sines, Still, Trajectory, random_motion
from measure.simulation.unusual import unusual_scenes

__all__ = [
    "Actor",
    "Box",
    "Capsule",
    "CaptureScene",
    "Chessboard",
    "Light",
    "Lighting",
    "Material",
    "MotionLimits",
    "Observation",
    "Print",
    "Renderer",
    "Scene",
    "Sensor",
    "Sines",
    "Sphere",
    "Still",
    "Trajectory",
    "charuco",
    "random_motion",
    "relit_scenes",
    "render",
    "scene_catalogue",
    "simulate_observations",
    "unusual_scenes",
    "write_capture",
    "write_session",
]

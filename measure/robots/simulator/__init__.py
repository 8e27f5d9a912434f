"""A simulated RAVEN-II: teleoperated motion through motors, cables, links, friction, gravity."""

from measure.robots.simulator.constants import Cables
from measure.robots.simulator.simulate import SimulatedRun, Teleoperation, simulate

__all__ = ["Cables", "SimulatedRun", "Teleoperation", "simulate"]

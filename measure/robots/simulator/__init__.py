"""A simulated RAVEN-II: teleoperated motion through motors, cables, links, friction, gravity."""

from measure.robots.simulator.mechanics import Cables
from measure.robots.simulator.simulate import SimulatedRun, simulate

__all__ = ["Cables", "SimulatedRun", "simulate"]

"""A simulated RAVEN-II: teleoperated motion through motors, cables, links, friction, gravity."""

from measure_learning.simulator.mechanics import Cables
from measure_learning.simulator.simulate import SimulatedRun, simulate
from measure_learning.simulator.slip import Slip

__all__ = ["Cables", "SimulatedRun", "Slip", "simulate"]

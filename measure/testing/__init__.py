"""The conformance kit: subclass one class, name your plugin, and pytest does the rest.

    from measure.testing import DetectorConformance

    class TestBlob(DetectorConformance):
        plugin = BlobDetector

Built-in plugins pass the same classes. `docs/writing_a_plugin.md` walks through an example.
"""

from measure.testing.command import CommandConformance
from measure.testing.detector import DetectorConformance
from measure.testing.format import FormatConformance
from measure.testing.pose_solver import PoseSolverConformance
from measure.testing.rules import PluginConformance
from measure.testing.scenes import Example, example
from measure.testing.sink import SinkConformance
from measure.testing.tracker import TrackerConformance
from measure.testing.triangulator import TriangulatorConformance

__all__ = [
    "CommandConformance", "DetectorConformance", "Example", "FormatConformance",
    "PluginConformance", "PoseSolverConformance", "SinkConformance", "TrackerConformance",
    "TriangulatorConformance", "example",
]  # fmt: skip

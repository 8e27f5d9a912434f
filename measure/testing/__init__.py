"""The conformance kit: subclass one class, name your plugin, and pytest does the rest.

    from measure.testing import DetectorConformance

    class TestBlob(DetectorConformance):
        plugin = BlobDetector

Built-in plugins pass the same classes. `docs/writing_a_plugin.md` walks through an example.
"""

from measure.testing.detector import DetectorConformance
from measure.testing.pose_solver import PoseSolverConformance
from measure.testing.rules import PluginConformance
from measure.testing.scenes import Example, example
from measure.testing.sink import SinkConformance
from measure.testing.triangulator import TriangulatorConformance

__all__ = [
    "DetectorConformance", "Example", "PluginConformance",
    "PoseSolverConformance", "SinkConformance", "TriangulatorConformance", "example",
]  # fmt: skip

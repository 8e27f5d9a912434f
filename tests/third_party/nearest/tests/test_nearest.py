from acme_nearest import NearestTriangulator

from measure.testing import TriangulatorConformance


class TestNearest(TriangulatorConformance):
    plugin = NearestTriangulator

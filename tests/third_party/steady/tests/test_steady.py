from acme_steady import SteadyTracker

from measure.testing import TrackerConformance


class TestSteady(TrackerConformance):
    plugin = SteadyTracker

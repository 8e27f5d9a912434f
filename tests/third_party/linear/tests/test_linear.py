from acme_linear import LinearEstimator

from measure.testing import EstimatorConformance


class TestLinear(EstimatorConformance):
    plugin = LinearEstimator

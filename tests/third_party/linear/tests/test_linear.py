from acme_linear import LinearEstimator

from measure_learning.testing import EstimatorConformance


class TestLinear(EstimatorConformance):
    plugin = LinearEstimator

from measure.testing import CommandConformance


class TestCount(CommandConformance):
    name = "count"

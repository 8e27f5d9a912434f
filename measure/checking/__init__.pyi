from measure.checking.coverage import Coverage, coverage_findings, expected_accuracy
from measure.checking.finding import Finding, Level, worst_first
from measure.checking.pictures import (
    ColorCount,
    DuplicateCount,
    ExposureCount,
    damage_findings,
    repeated_causes,
    stamp_findings,
)
from measure.checking.search import SearchSample, search_sample, with_velocities

__all__ = [
    "ColorCount", "Coverage", "DuplicateCount", "ExposureCount", "Finding", "Level",
    "SearchSample", "coverage_findings", "damage_findings", "expected_accuracy", "repeated_causes",
    "search_sample", "stamp_findings", "with_velocities", "worst_first",
]  # fmt: skip

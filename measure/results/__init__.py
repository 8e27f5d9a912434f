"""The run folder: written row by row, read back, evaluated, exported."""

from measure.results.provenance import Provenance, digest, versions
from measure.results.run import Run, read_run
from measure.results.summary import Summary
from measure.results.writer import RunWriter

__all__ = [
    "Provenance",
    "Run",
    "RunWriter",
    "Summary",
    "digest",
    "read_run",
    "versions",
]

from measure.results.evaluation import RunEvaluation, evaluate
from measure.results.folder import check_run_folder
from measure.results.provenance import Provenance, digest, versions
from measure.results.run import Run, read_run, read_runs
from measure.results.single_errors import Marks, read_marks
from measure.results.summary import Summary
from measure.results.writer import RunWriter

__all__ = [
    "Marks", "Provenance", "Run", "RunEvaluation", "RunWriter", "Summary", "check_run_folder",
    "digest", "evaluate", "read_marks", "read_run", "read_runs", "versions",
]  # fmt: skip

"""A run's report."""

from __future__ import annotations

from pathlib import Path


def report(run_path: Path, out: Path | None = None, truth: Path | None = None) -> Path:
    """Write the report of a run as one self-contained HTML file.

    Args:
        run_path: the run's folder.
        out: the file; `report.html` in the run's folder if omitted.
        truth: poses over time; those of the run's session if omitted and there are any.

    Returns:
        Where it was written.

    Raises:
        RunError: the folder is no run, or the truth cannot be read or is not the run's.
        ConfigError: the file cannot be written, or is there and no page.
    """
    from measure.api.evaluate import truth_of
    from measure.api.outputs import check_page_writable
    from measure.errors import RunError
    from measure.results import read_run
    from measure.results.evaluation import pose_errors
    from measure.session import read_trajectory
    from measure.viewing.report.run_report import write_report

    run = read_run(run_path)
    truth = (truth or truth_of(run)) if run.poses.num_rows else None
    errors = None if truth is None else pose_errors(run, read_trajectory(truth, RunError))
    path = out or run_path / "report.html"
    check_page_writable(path)
    write_report(run, path, errors)
    return path

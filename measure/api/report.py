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
        RunError: the folder is no run, the truth given cannot be read, or the file is there and no
            page.
    """
    from measure.api.evaluate import truth_of
    from measure.errors import RunError
    from measure.results import read_run
    from measure.results.evaluation import pose_errors
    from measure.session import read_trajectory
    from measure.viewing.report.run_report import write_report

    run = read_run(run_path)
    truth = truth or truth_of(run)
    errors = None if truth is None else pose_errors(run, read_trajectory(truth, RunError))
    path = out or run_path / "report.html"
    if path.exists() and path.suffix.lower() not in (".html", ".htm"):
        raise RunError(f"{path} is there already and is no report: give a new file, or a .html")
    write_report(run, path, errors)
    return path

"""A run's report."""

from __future__ import annotations

from pathlib import Path


def report(run_path: Path, out: Path | None = None) -> Path:
    """Write the report of a run as one self-contained HTML file.

    Args:
        run_path: the run's folder.
        out: the file; `report.html` in the run's folder if omitted.

    Returns:
        Where it was written.

    Raises:
        RunError: the folder is no run.
    """
    from measure.results import read_run
    from measure.viewing.report.run_report import write_report

    run = read_run(run_path)
    path = out or run_path / "report.html"
    write_report(run, path)
    return path

"""`measure report`: a run as one HTML file."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.console import OutFile, Overwrite
from measure_lab import api


def report(
    run: Path,
    /,
    *,
    out: OutFile | None = None,
    overwrite: Overwrite = False,
    truth: Path | None = None,
    body: str | None = None,
    frame: Path | None = None,
) -> None:
    """Write a run's report as one HTML file.

    Everything is inside the file: it can be mailed, and opens without a network.

    Args:
        run: the run's folder.
        out: the file to write; report.html in the run's folder if omitted.
        truth: a trajectory to compare with; the session's own if omitted.
        body: which body, of a run of several; all if omitted.
        frame: written by `measure register`: show poses in the axes of the robot's base.
    """
    console.print_text(str(api.report(run, out, truth, body, overwrite, frame)))

"""`measure export`: a run in another program's format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite


def export(
    run: Path,
    /,
    *,
    format_: Annotated[str, Parameter(name=("--format", "-f"))],
    out: OutFile | None = None,
    overwrite: Overwrite = False,
    body: str | None = None,
    smooth: float | None = None,
    velocity: bool = False,
    json: JsonFlag = False,
) -> None:
    """Write a run in another program's format.

    Args:
        run: the run's folder.
        format_: csv (poses with covariances), tum (evo; metres), trc (OpenSim markers), c3d
            (markers) or mcap (ROS 2; metres).
        out: the file to write; export.FORMAT in the run's folder if omitted.
        body: which body, of a run of several; all if omitted.
        smooth: smooth the unflagged poses by cubics over so many seconds on either side; they are
            as measured if omitted. Of csv, tum and mcap.
        velocity: write velocities as well, with their covariance. Of csv and mcap.
    """
    path = api.export(run, format_, out, overwrite, body, smooth_s=smooth, velocity=velocity)
    if json:
        console.print_json({"run": str(run), "format": format_, "file": str(path)})
    else:
        console.print_text(f"written to {path}")

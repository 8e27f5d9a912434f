"""`measure simulate`: a recording of a robot that never was."""

from __future__ import annotations

from typing import Annotated

from measure import api
from measure.cli import console
from measure.cli.console import OutFile, Overwrite
from measure.cli.options import FIELDS


def simulate(
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    options: Annotated[api.RenderOptions, FIELDS] = api.RenderOptions(),
) -> None:
    """Render a recording of the simulated RAVEN-II, with its log and its truth.

    Args:
        out: the session's folder. The robot's log is `robot.parquet` in it.
    """
    with (
        api.new_folder(out, overwrite, "session.toml"),
        console.progress("rendering", unit="pictures") as report,
    ):
        api.simulate_recording(out, options, report)
    console.print_text(f"written to {out}; measure it with: measure run {out} -o RUN")

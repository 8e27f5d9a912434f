"""`measure simulate`: a recording of a robot that never was."""

from __future__ import annotations

from typing import Annotated

from measure import api
from measure.cli import console
from measure.cli.console import OutFile, Overwrite
from measure.cli.options import FIELDS
from measure_learning import api as learning_api


def simulate(
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    options: Annotated[learning_api.RenderOptions, FIELDS] = learning_api.RenderOptions(),
) -> None:
    """Render a recording of the simulated RAVEN-II, with its log and its truth.

    Args:
        out: the session's folder. The robot's log is `robot.parquet` in it.
    """
    with (
        api.new_folder(out, overwrite, "session.toml"),
        console.progress("rendering", unit="pictures") as report,
    ):
        learning_api.simulate_recording(out, options, report)
    console.print_text(f"written to {out}; measure it with: measure run {out} -o RUN")

"""`measure sweep`: a search among an estimator's settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from measure.cli import console
from measure.cli.console import JsonFlag, shares
from measure.cli.options import FIELDS
from measure_learning import api


def sweep(
    data: Path,
    space: Path,
    /,
    *,
    journal: Path,
    set_: tuple[str, ...] = (),
    options: Annotated[api.SweepOptions, FIELDS] = api.SweepOptions(),
    json: JsonFlag = False,
) -> None:
    """Search an estimator's hyperparameters, optionally on several machines.

    Start the same command as often as you like on this machine: they share the work. `--cluster`
    gives it to other machines. A killed worker's settings are tried again.

    Args:
        data: a data set.
        space: a TOML file with a table per setting: choices, or low and high (log, integer).
        journal: the sweep's file; an unfinished sweep goes on.
        set_: a setting as NAME=VALUE that all trials share; may be repeated.
    """
    with console.progress("sweeping", unit="per mille") as report:
        settings = api.parse_settings(set_)
        state = api.sweep(data, space, journal, options, shares(report), settings)
    if json:
        console.print_json(state)
        return
    rows = [
        (value, " ".join(f"{k}={v}" for k, v in chosen.items())) for value, chosen in state.best
    ]
    console.print_table(("RMS_mm", "settings"), rows)
    console.print_text(
        f"{state.finished} trials finished, {state.failed} failed or abandoned, "
        f"{state.running} running; {journal}"
    )

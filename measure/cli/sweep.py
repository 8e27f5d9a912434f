"""`measure sweep`: a search among an estimator's settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag, shares
from measure.cli.options import SettingTexts


@Parameter(name="*")
@dataclass(frozen=True)
class _EstimatorOptions:
    """What is searched.

    Attributes:
        estimator: the plugin.
        set_: a setting as NAME=VALUE that all trials share; may be repeated.
    """

    estimator: str = "mlp"
    set_: SettingTexts = ()


def sweep(
    data: Path,
    space: Path,
    /,
    *,
    journal: Path,
    of: _EstimatorOptions = _EstimatorOptions(),
    trials: int = 100,
    split_seed: int = 0,
    scheduler: str | None = None,
    json: JsonFlag = False,
) -> None:
    """Search an estimator's settings, on many machines if there are.

    Start the same command as often as you like, on any machine that sees the journal: they share
    the work. A killed worker's settings are tried again.

    Args:
        data: a data set.
        space: a TOML file with a table per setting: choices, or low and high (log, integer).
        journal: the sweep's file; an unfinished sweep goes on.
        trials: finished trials wanted in all.
        split_seed: which trajectories validate.
        scheduler: address of a dask scheduler whose workers shall run the trials.
    """
    from measure import api

    with console.progress("sweeping", unit="per mille") as report:
        options = api.SweepOptions(
            of.estimator, api.parse_settings(of.set_), trials, split_seed, scheduler
        )
        state = api.sweep(data, space, journal, options, shares(report))
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

"""`measure compare`: what differs between two runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure.limits import MOST_LISTED
from measure_lab import api


@command(api.compare, arguments=2)
def compare(found: api.Comparison, first: Path, second: Path, json: JsonFlag = False) -> None:
    """Print what differs, and by how much."""
    if json:
        figures = [{**vars(figure), "sds": figure.sds} for figure in found.figures]
        facts = {**vars(found), "figures": figures}
        console.print_json({"first": str(first), "second": str(second), **facts})
        return
    how = (
        f"one session, {found.paired} frame sets with an unflagged pose in both"
        if found.same_session
        else "two sessions, compared by their statistics"
    )
    console.print_text(f"{first} and {second}: {how}")
    console.print_table(
        ("differs", "first", "second"),
        [
            (key, *(f"{value:.24}" for value in values))  # of a digest the first letters say enough
            for key, values in [*found.settings.items()][:MOST_LISTED]
        ],
    )
    if len(found.settings) > MOST_LISTED:
        console.print_text(f"and {len(found.settings) - MOST_LISTED} more: --json has them")
    states = [(f"frame sets {state}", *counts, counts[1] - counts[0], "", "", "")
              for state, counts in found.states.items()]  # fmt: skip
    rows = [
        (f.what, f"{f.first:.4f}", f"{f.second:.4f}", f"{f.difference:+.4f}", _digits(f.sd),
         f"{f.sds:+.1f}" if np.isfinite(f.sds) else "", _digits(f.stated_sd))
        for f in found.figures
    ]  # fmt: skip
    heads = ("mean of", "first", "second", "difference", "sd", "sds", "stated_sd")
    console.print_table(heads, [*states, *rows])


def _digits(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""

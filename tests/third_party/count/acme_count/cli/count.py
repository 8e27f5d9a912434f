"""Counting poses."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.results import read_run


def count(*runs: Path, json: JsonFlag = False) -> None:
    """Count the poses of runs.

    Args:
        runs: the runs' folders.
    """
    found = {str(run): int(read_run(run).has_pose.sum()) for run in runs}
    if json:
        console.print_json(found)
    else:
        console.print_table(("run", "poses"), list(found.items()))

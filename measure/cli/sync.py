"""`measure sync`: the clocks of cameras that were started by hand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command


@command(api.sync, "looking", "pictures")
def sync(
    clocks: Mapping[str, api.SyncedClock], session: Path, out: Path | None, json: JsonFlag = False
) -> None:
    """Print what was added to the times of each camera."""
    if json:
        console.print_json({name: clock._asdict() for name, clock in clocks.items()})
        return
    rows = [(name, clock.offset_s, 1e3 * clock.sd_s) for name, clock in clocks.items()]
    console.print_table(("camera", "added_s", "sd_ms"), rows)
    console.print_text(f"wrote {out or session}")

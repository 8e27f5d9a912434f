"""`measure sync`: the clocks of cameras that were started by hand."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry


def sync(
    session: Path,
    /,
    *,
    out: OutFile | None = None,
    overwrite: Overwrite = False,
    seconds: float = 120.0,
    profile: str = "precise",
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Synchronise cameras that were started by hand, by the balls' motion.

    Writes what to add to each camera's times as `time_offset_s` into the session file; the first
    camera's clock is kept. Refused where the motion cannot tell.

    Args:
        session: the session's folder.
        out: a new session file to write instead of the session's own, in the same folder.
        seconds: how much of each recording is looked at, from its start.
        profile: how to measure the session, by name or TOML file.
    """
    chosen = api.load_profile(profile)
    with console.progress("looking", "pictures") as report:
        clocks = api.sync(session, registry, chosen, out, overwrite, seconds, report)
    if json:
        console.print_json({name: clock._asdict() for name, clock in clocks.items()})
        return
    rows = [(name, clock.offset_s, 1e3 * clock.sd_s) for name, clock in clocks.items()]
    console.print_table(("camera", "added_s", "sd_ms"), rows)
    console.print_text(f"wrote {out or session}")

"""`measure mend`: what is off taken out of a copy of the calibration, the body and the stamps."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry


def mend(
    session: Path,
    /,
    *,
    out: OutFile,
    profile: str = "precise",
    overwrite: Overwrite = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Correct faults in a copy of a session's calibration, body and timestamps.

    It mends what `measure check` names, one cause after the other, by two thirds of the recording,
    and keeps a mend only if the other third fits better. The session and its pictures stay as they
    are: the new folder names the pictures by their paths.

    The exit code is 3, and nothing is written, where two causes that need different mends explain
    the recording, where a mend makes it fit no better, or where only a person can mend it.

    Args:
        session: the session's folder; it is only read.
        out: the folder to write, a session that `measure run` measures.
        profile: `precise`, or the path of a profile of your own (.toml).
    """
    how = api.load_profile(profile)
    with console.progress("looking") as report:
        found = api.mend(session, out, registry, how, overwrite=overwrite, progress=report)
    if json:
        console.print_json({"output": None if found.refused else out, **vars(found)})
    else:
        for line in found.lines():
            console.print_text(line)
        if not found.refused:
            console.print_text(f"wrote {out}")
    return console.UNBELIEVABLE if found.refused else 0

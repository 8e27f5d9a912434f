"""`measure mend`: what is off taken out of a copy of the calibration, the body and the stamps."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command


@command(api.mend, "looking")
def mend(found: api.Mended, out: Path, json: JsonFlag = False) -> int:
    """Print what was changed, or why nothing was."""
    if json:
        console.print_json({"output": None if found.refused else out, **vars(found)})
    else:
        for line in found.lines():
            console.print_text(line)
        if not found.refused:
            console.print_text(f"wrote {out}")
    return console.UNBELIEVABLE if found.refused else 0

"""`measure target`: a printable sheet from a target file."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command


@command(api.draw_target)
def target(drawn: tuple[api.Sheet, Path], json: JsonFlag = False) -> None:
    """Print what was written, and how large it is."""
    sheet, written = drawn
    width, height = sheet.size_mm
    if json:
        size = [width, height]
        console.print_json(
            {"output": written, "paper": sheet.paper, "size_mm": size, "note": sheet.note}
        )
        return
    paper = sheet.paper or "no standard paper"
    console.print_text(f"wrote {written}: {width:.0f} x {height:.0f} mm ({paper}), print at 100 %")
    if sheet.note:
        console.print_text(f"note: {sheet.note}")

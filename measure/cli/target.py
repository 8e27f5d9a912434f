"""`measure target`: a printable sheet from a target file."""

from __future__ import annotations

from pathlib import Path

from measure.api import draw_target
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite


def target(
    target_file: Path,
    /,
    *,
    out: OutFile | None = None,
    run: Path | None = None,
    overwrite: Overwrite = False,
    json: JsonFlag = False,
) -> None:
    """Draw a printable board, marker field or body.

    Args:
        target_file: TOML of the target, or the name of one that comes with the program:
            charuco_8x5_27, chessboard_9x6_25, raven_markers_16, raven_three_ball.
        out: .pdf or .svg to write; the target's name with .pdf in this folder if omitted.
        run: a run of a body like TARGET_FILE: its arms are made so long that its balls hide each
            other in less than 15 % of the views there, and its body file is written beside the
            sheet.
    """
    sheet, written = draw_target(target_file, out, overwrite, run)
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

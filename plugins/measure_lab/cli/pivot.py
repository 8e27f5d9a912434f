"""`measure pivot`: the tip of a tool that is turned about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure_lab import api


@command(api.pivot)
def pivot(found: api.TipResult, run: Path, out: Path | None, json: JsonFlag = False) -> None:
    """Print the tip, and how it was found."""
    if json:
        console.print_json({"run": str(run), **_values(found), "output": out})
        return
    _print(found)
    if out is not None:
        console.print_text(f"wrote {out}: measure with it, and positions are the tip's")


def _print(found: api.TipResult) -> None:
    tip, axis = found.pivot, found.axis
    place = ", ".join(f"{value:.3f}" for value in tip.tip_mm)
    console.print_text(f"tip at ({place}) mm in the body, sd {tip.tip_sd_mm:.3f} mm (3-D)")
    console.print_text(
        f"{tip.poses} poses, {tip.left_out} left out as they disagree; turned by "
        f"{tip.swing_deg:.0f} deg, {tip.needed_deg:.0f} were needed; the tip stays within "
        f"{tip.rms_mm:.3f} mm RMS, {tip.normalised**0.5:.1f} times what the poses state"
    )
    if axis is not None:
        along = ", ".join(f"{value:.5f}" for value in axis.direction)
        console.print_text(
            f"axis along ({along}) in the body, sd {axis.sd_deg:.3f} deg; spun by "
            f"{axis.turned_deg:.0f} deg"
        )


def _values(found: api.TipResult) -> dict[str, Any]:
    values = {"tip_sd_mm": found.pivot.tip_sd_mm, **vars(found.pivot)}
    if found.axis is not None:
        values |= {f"axis_{key}": value for key, value in vars(found.axis).items()}
    return values

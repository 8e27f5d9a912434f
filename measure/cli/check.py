"""`measure check`: what is wrong or weak in a recording, before it is measured."""

from __future__ import annotations

import numpy as np

from measure import api
from measure.api.check import SessionCheck
from measure.checking import Level
from measure.checking.causes import MEND
from measure.checking.clocks import CameraClock
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command
from measure.results.summary import WHICH_ACCURACY


@command(api.check, "looking")
def check(found: SessionCheck, json: JsonFlag = False) -> int:
    """Print the findings, the likeliest cause first."""
    if json:
        console.print_json(found)
    else:
        _print(found)
    return 0 if found.believable else console.UNBELIEVABLE


def _print(found: SessionCheck) -> None:
    if found.causes:
        first = found.causes[0]
        console.print_text(f"{first.cause} of {first.of} ({first.level}): {first.text}")
    console.print_text(
        f"{found.session}: looked at {found.looked_at} of {found.frame_sets} frame sets"
    )
    if found.findings:
        rows = [(f.level.value, f.topic, f.text) for f in found.findings]
        console.print_table(("level", "topic", "what"), rows)
    else:
        console.print_text("nothing wrong, nothing weak")
    if any(cause.mendable and cause.level is Level.WRONG for cause in found.causes):
        console.print_text(f"{MEND} writes a copy in which that is put right, if the motion tells")
    lengths = [
        (" - ".join(c.what), c.measured_mm, c.sd_mm, c.file_mm, c.frames)
        for c in (*found.body.distances, *found.body.radii)
    ]
    if lengths:
        console.print_table(("body", "measured_mm", "sd_mm", "file_mm", "frame sets"), lengths)
    for blind in found.body.blind_to:
        console.print_text(f"this recording cannot show {blind}")
    if found.clocks:
        _print_clocks(found.clocks)
    if found.accuracy is not None and np.any(np.isfinite(found.accuracy[:, 3])):
        position, turn = found.accuracy[:, 3], found.accuracy[:, 4]
        console.print_text(
            "to be expected within 40 mm of where the body was: "
            f"{np.nanmin(position):.3f} to {np.nanmax(position):.3f} mm "
            f"and {np.nanmin(turn):.3f} to {np.nanmax(turn):.3f} deg (one standard deviation)"
        )
        console.print_text(f"  {WHICH_ACCURACY['forecast']}")


def _print_clocks(clocks: tuple[CameraClock, ...]) -> None:
    """Print the clocks, and those that the motion does not determine."""
    estimated = [c for c in clocks if np.isfinite(c.offset_sd_s)]
    if estimated:
        rows = [(c.camera, 1e3 * c.offset_s, 1e3 * c.offset_sd_s, *_readout(c)) for c in estimated]
        heads = ("clock", "offset_ms", "sd_ms", "readout_ms", "readout_sd_ms")
        console.print_table(heads, rows)
    if unknown := [c.camera for c in clocks if c not in estimated]:
        console.print_text(
            f"whether the clocks of {', '.join(unknown)} agree cannot be seen: "
            "move the body to and fro for some seconds"
        )
    if blurred := [c.camera for c in estimated if not np.isfinite(c.readout_sd_s)]:
        console.print_text(
            f"whether the shutters of {', '.join(blurred)} roll cannot be seen: "
            "move the body faster, and up and down in the pictures"
        )


def _readout(clock: CameraClock) -> tuple[float | None, float | None]:
    if not np.isfinite(clock.readout_sd_s):
        return None, None
    return 1e3 * clock.readout_s, 1e3 * clock.readout_sd_s

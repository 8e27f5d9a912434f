"""`measure refine`: the moving balls as the calibration wand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure import api
from measure.checking.clocks import CameraClock
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import RequiredOut, command


@command(api.refine, "measuring", out=RequiredOut)
def refine(
    result: api.RefineResult, out: Path, body_output: Path | None, json: JsonFlag = False
) -> None:
    """Print changes of the cameras, clocks, and the accuracy before and after."""
    if json:
        console.print_json({"output": out, **result.calibration.provenance})
        return
    _print(result)
    console.print_text(f"wrote {' and '.join(map(str, filter(None, (out, body_output))))}")


def _print(result: api.RefineResult) -> None:
    rig = result.rig
    refinement, verdict = rig.refinement, rig.verdict
    rows = []
    for name, (before, after) in refinement.rms_px.items():
        change = refinement.change[refinement.columns[name]]
        moved, turned = np.linalg.norm(change[:3]), np.degrees(np.linalg.norm(change[3:6]))
        rows.append((name, before, after, float(moved), float(turned)))
    console.print_table(("camera", "rms_before_px", "rms_after_px", "moved_mm", "turned_deg"), rows)
    for clock in rig.clocks:
        if np.isfinite(clock.offset_sd_s):
            console.print_text(
                f"clock of {clock.camera}: {1000 * clock.offset_s:+.1f} ms, "
                f"sd {1000 * clock.offset_sd_s:.1f} ms{_clock_words(clock, rig.clocks_applied)}"
            )
        if clock.rolling and rig.clocks_applied:
            console.print_text(
                f"shutter of {clock.camera}: {1000 * clock.readout_s:+.1f} ms from first to last "
                f"row, sd {1000 * clock.readout_sd_s:.1f} ms: in the calibration from now on"
            )
    for note in result.notes:
        console.print_text(f"note: {note}")
    camera, body = verdict.camera_sd_mm, verdict.body_sd_mm
    if result.freed:
        console.print_text(
            f"{refinement.frames} frame sets; expected body position error from what was freed "
            f"{body[1]:.3f} mm"
        )
        return
    console.print_text(
        f"{refinement.frames} frame sets; camera positions known to {camera[1]:.3f} mm (were "
        f"{camera[0]:.3f} mm); expected body position error from the calibration {body[1]:.3f} mm "
        f"(was {body[0]:.3f} mm)"
    )


def _clock_words(clock: CameraClock, applied: bool) -> str:
    if not applied and clock.offset_visible:
        return (
            ": not applied, because a camera misses for another reason as well: was it moved, or "
            "does its shutter roll? `measure check` tells"
        )
    if not applied:
        return ": not beyond doubt, not applied"
    if clock.offset_visible:
        return ": set right, here and when this recording is measured with the new calibration"
    return ": applied here"

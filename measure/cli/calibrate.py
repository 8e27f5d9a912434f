"""`measure calibrate`: from a capture folder, or a waved body, to `calibration.toml`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from measure import api
from measure.calibration import camera_rows, judgement_lines
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command


@command(api.calibrate_to, "calibrating", "steps")
def calibrate(made: tuple[api.CalibrationResult, Path], out: Path, json: JsonFlag = False) -> int:
    """Print the cameras and the judgement."""
    result, page = made
    code = 0 if result.verdict.trustworthy else console.UNBELIEVABLE
    if json:
        console.print_json({"output": out, **result.calibration.provenance})
        return code
    console.print_table(
        ("camera", "f_px", "position_sd_mm", "rotation_sd_deg", "rms_px"),
        camera_rows(result.rig.cameras),
    )
    findings = result.verdict.findings
    reported = tuple(f for f in findings if f.level != "note" or f.topic != "lens")
    for line in judgement_lines(result.rig, replace(result.verdict, findings=reported)):
        console.print_text(line)
    console.print_text(f"wrote {out} and {page}")
    if notes := len(findings) - len(reported):
        console.print_text(f"{notes} notes on lenses ask for nothing: {page} lists them")
    return code

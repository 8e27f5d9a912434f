"""`measure calibrate`: from a capture folder to `calibration.toml`."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.calibration import JOINT, camera_rows
from measure.cli import console
from measure.cli.console import CalibrationFormat, JsonFlag, OutFile, Overwrite


def calibrate(
    capture: Path,
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    method: str = JOINT,
    body: Path | None = None,
    file_format: CalibrationFormat = "triball",
    report: Path | None = None,
    json: JsonFlag = False,
) -> int:
    """Calibrate cameras from pictures of boards and markers.

    The exit code is 3 if the judgement finds anything wrong; the calibration is then written as
    well.

    Args:
        capture: capture folder (docs/calibration.md), or its capture.toml.
        out: the calibration to write.
        method: "joint" solves all cameras at once; "paper" each from its markers (equation 3).
        body: body to judge the calibration with; the paper's three-ball body if omitted.
        file_format: triball, anipose, caliscope or opencv; only "triball" holds covariances and
            the judgement.
        report: HTML report to write; beside the output, ending in .html, if omitted.
    """
    with console.progress("calibrating", "cameras") as progress:
        result, page = api.calibrate_to(
            out, capture, method, body, progress,
            file_format=file_format, report=report, overwrite=overwrite,
        )  # fmt: skip
    code = 0 if result.verdict.trustworthy else console.UNBELIEVABLE
    if json:
        console.print_json({"output": out, **result.calibration.provenance})
        return code
    console.print_table(
        ("camera", "f_px", "position_sd_mm", "rotation_sd_deg", "rms_px"),
        camera_rows(result.rig.cameras),
    )
    notes = [str(f) for f in result.verdict.findings if f.level == "note" and f.topic == "lens"]
    for line in result.lines():
        if line not in notes:
            console.print_text(line)
    console.print_text(f"wrote {out} and {page}")
    if notes:
        console.print_text(f"{len(notes)} notes on lenses ask for nothing: {page} lists them")
    return code

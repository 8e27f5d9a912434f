"""`measure calibrate`: from a capture folder, or a waved body, to `calibration.toml`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from measure import api
from measure.calibration import JOINT, camera_rows, judgement_lines
from measure.cli import console
from measure.cli.console import CalibrationFormat, JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry
from measure.errors import ConfigError


def calibrate(
    capture: Path,
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    method: str = JOINT,
    body: Path | None = None,
    lenses: Path | None = None,
    file_format: CalibrationFormat = "triball",
    report: Path | None = None,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Calibrate cameras from pictures of boards and markers, or of the waved body.

    The exit code is 3 if the judgement finds anything wrong; the calibration is then written as
    well.

    Args:
        capture: capture folder (docs/calibration.md), or its capture.toml; or a session in which
            the body is waved, which needs no calibration: the world is the first camera's frame.
        out: the calibration to write.
        method: "joint" solves all cameras at once; "paper" each from its markers (equation 3).
        body: the waved body; or the one to judge a capture's calibration with, the paper's
            three-ball body if omitted.
        lenses: for a session, a calibration that gives the lenses only.
        file_format: triball, anipose, caliscope or opencv; only "triball" holds covariances and
            the judgement.
        report: HTML report to write; beside the output, ending in .html, if omitted.
    """
    if api.is_session(capture):
        if method != JOINT:
            raise ConfigError(f"--method {method}: a waved body calibrates all cameras at once")
        with console.progress("calibrating") as progress:
            result, page = api.calibrate_by_body_to(
                out, capture, body, registry, lenses, progress,
                file_format=file_format, report=report, overwrite=overwrite,
            )  # fmt: skip
    else:
        if lenses is not None:
            raise ConfigError("--lenses: a capture.toml names the lenses of its cameras itself")
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
    findings = result.verdict.findings
    reported = tuple(f for f in findings if f.level != "note" or f.topic != "lens")
    for line in judgement_lines(result.rig, replace(result.verdict, findings=reported)):
        console.print_text(line)
    console.print_text(f"wrote {out} and {page}")
    if notes := len(findings) - len(reported):
        console.print_text(f"{notes} notes on lenses ask for nothing: {page} lists them")
    return code

"""`measure refine`: the moving balls as the calibration wand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cyclopts import Parameter

from measure.api import RefineResult
from measure.api import refine as run
from measure.api.outputs import check_apart, output
from measure.calibration import RefineSettings
from measure.checking.clocks import CameraClock
from measure.cli import console
from measure.cli.console import CalibrationFormat, JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry
from measure.errors import ConfigError
from measure.session import write_body, write_calibration


@Parameter(name="*")
@dataclass(frozen=True)
class _OutputOptions:
    """The files to write.

    Attributes:
        out: the calibration to write.
        file_format: triball, anipose, caliscope or opencv; only "triball" holds covariances and
            notes.
        body_output: body file to write, with the balls where the recording puts them.
    """

    out: OutFile
    file_format: CalibrationFormat = "triball"
    body_output: Path | None = None
    overwrite: Overwrite = False


def refine(
    session: Path,
    /,
    *,
    to: _OutputOptions,
    profile: str = "precise",
    calibration: Path | None = None,
    only: tuple[str, ...] = (),
    body_tolerance_mm: float | None = None,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Refine a calibration from the moving balls themselves.

    A camera that the others contradict while they agree is freed alone, and said; they stay as they
    are. What would be shared out among all cameras (a zoom of all, another scale, a ball elsewhere,
    a camera moved midway) is refused.

    Args:
        session: recording in which the body is carried through the whole workspace.
        profile: how to measure the session, by name or TOML file.
        calibration: first calibration, if not the session's own.
        only: a camera to free, the others held; may be repeated.
        body_tolerance_mm: how exactly the balls sit on the body (standard deviation); 0 is exact;
            what the body file states, or 0.05, if omitted.
    """
    given, outs = body_tolerance_mm, [to.out, *([to.body_output] if to.body_output else [])]
    check_apart(*outs)
    with output(to.out, to.overwrite) as file, output(to.body_output, to.overwrite) as body:
        if given is not None and not 0 <= given < math.inf:
            raise ConfigError(f"--body-tolerance-mm {given:g}: must be 0 or more")
        with console.progress("measuring") as report:
            settings = RefineSettings(given)
            result = run(session, registry, profile, settings, calibration, report, only)
        write_calibration(file, result.calibration, to.file_format)
        write_body(body, result.body)
    if json:
        console.print_json({"output": to.out, **result.calibration.provenance})
        return
    _print(result)
    console.print_text(f"wrote {' and '.join(map(str, outs))}")


def _print(result: RefineResult) -> None:
    """Print changes of the cameras, clocks, and the accuracy before and after."""
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

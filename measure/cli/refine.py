"""`measure refine`: the moving balls as the calibration wand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.injected import InjectedRegistry


def refine(
    session: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=("--output", "-o"))],
    profile: str = "precise",
    calibration: Path | None = None,
    body_tolerance_mm: float = 0.05,
    clock_tolerance_s: float = 0.02,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Refine a calibration from the moving balls themselves.

    Args:
        session: recording in which the body is carried through the whole workspace.
        output: the calibration to write.
        profile: how to measure the session, by name or TOML file.
        calibration: first calibration, if not the session's own.
        body_tolerance_mm: how exactly the balls sit on the body (standard deviation); 0 is exact.
        clock_tolerance_s: how exactly the cameras' clocks agree; 0 trusts the time stamps.
    """
    from measure.api import refine as run
    from measure.calibration import RefineSettings
    from measure.session import write_calibration

    settings = RefineSettings(body_tolerance_mm, clock_tolerance_s)
    with console.progress("measuring") as progress:
        result = run(session, registry, profile, settings, calibration, progress)
    write_calibration(output, result.calibration)
    if json:
        console.print_json({"output": output, **result.calibration.provenance})
        return
    refinement = result.refinement
    rows = [
        (name, before, after, 1000 * refinement.clock_offsets_s[name])
        for name, (before, after) in refinement.rms_px.items()
    ]
    console.print_table(("camera", "rms_before_px", "rms_after_px", "clock_offset_ms"), rows)
    console.print_text(
        f"{refinement.frames} frame sets; expected body position error from the calibration "
        f"{result.expected_mm[1]:.3f} mm (was {result.expected_mm[0]:.3f} mm); wrote {output}"
    )
    for note in result.notes:
        console.print_text(f"note: {note}")

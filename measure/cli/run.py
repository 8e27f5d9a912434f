"""`measure run`: a recorded session becomes poses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.injected import InjectedRegistry


def run(
    session: Path,
    /,
    *,
    out: Annotated[Path, Parameter(name=("--out", "-o"))],
    profile: str = "precise",
    detector: str | None = None,
    triangulator: str | None = None,
    solver: str | None = None,
    set_: Annotated[tuple[str, ...], Parameter(name="--set")] = (),
    calibration: Path | None = None,
    body: Path | None = None,
    images: str = "none",
    recording: Annotated[bool, Parameter(negative="--no-recording")] = True,
    resume: bool = False,
    overwrite: bool = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Measure a recorded session.

    Every frame set becomes a row of the run: `ok`, `flagged` (a pose to doubt), `lost` or
    `skipped` (no pose, and why).

    Args:
        session: the session's folder; it is only read.
        out: the run's folder, made if it is not there.
        profile: `precise`, `paper`, or the path of a profile of your own (.toml).
        detector: a detector plugin to use instead of the profile's.
        triangulator: likewise.
        solver: likewise, a pose solver.
        set_: a setting as STAGE.NAME=VALUE, such as detector.rays=128; may be repeated.
        calibration: a calibration to use instead of the session's.
        body: a body file to use instead of the session's.
        images: pictures to keep in the viewer's recording: none, all, or every N-th set.
        recording: write run.rrd for the viewer.
        resume: go on with an interrupted run.
        overwrite: throw an earlier run in the folder away.
    """
    from measure import api

    chosen = api.choose(
        api.load_profile(profile),
        {"detector": detector, "triangulator": triangulator, "solver": solver},
        set_,
    )
    options = api.RunOptions(
        image_every=api.parse_images(images),
        recording=recording,
        resume=resume,
        overwrite=overwrite,
        calibration=calibration,
        body=body,
    )
    with console.progress("measuring") as report:
        summary = api.run(session, out, chosen, registry, options, report)
    if json:
        console.print_json({"run": str(out), **summary.values()})
        return
    console.print_text(summary.sentence())
    for reason, count in summary.reasons.items():
        console.print_text(f"  {count} x {reason}")
    for note in summary.notes:
        console.print_text(f"note: {note}")
    console.print_text(f"written to {out}; look at it with: measure view {out}")

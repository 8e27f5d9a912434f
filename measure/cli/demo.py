"""`measure demo`: the whole way once, without any hardware."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry
from measure.learning import EstimatorEvaluation


def demo(
    *,
    out: OutFile = Path("triball-demo"),
    overwrite: Overwrite = False,
    profile: str = "precise",
    frames: int = 30,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Render a session, measure it, compare with the truth; correct a simulated robot.

    Four webcams look at three balls that move. The pictures have lens distortion, blur, a colour
    mosaic, noise and JPEG artefacts; where the balls really were is known exactly. Then the second
    half of the way: the shipped network corrects a simulated robot's position, without a camera.

    Args:
        out: folder for the session and the run.
        profile: how to measure: `precise`, `paper`, or the path of a profile of your own (.toml).
        frames: frame sets to render.
    """
    chosen = api.load_profile(profile)
    with console.progress("rendering and measuring", "steps") as report:
        made = api.demo(out, chosen, registry, frames, report, overwrite)
    if json:
        console.print_json(dataclasses.asdict(made) | {"profile": chosen.name})
        return
    console.print_text(made.summary.sentence())
    found = made.evaluation
    rows = []
    if found.body is not None and found.rotation is not None:
        rows = [
            ("position, mm", found.body.rms_3d_mm, found.body.max_3d_mm),
            ("rotation, deg", found.rotation.rms_3d_deg, found.rotation.max_3d_deg),
        ]
    console.print_text(f"{found.compared} of {found.frame_sets} poses against the exact truth")
    console.print_table(("error", "RMS", "largest"), rows)
    _print_correction(made.correction)
    console.print_text(f"session  {made.session}")
    console.print_text(f"run      {made.run}  (poses.csv opens in any spreadsheet)")
    console.print_text(f"picture  {made.picture}")
    console.print_text(f"look at it in 3-D:     measure view {made.run}")
    console.print_text(f"every error in detail: measure evaluate {made.run}")


def _print_correction(found: EstimatorEvaluation) -> None:
    """Print the accuracy of the shipped network on a simulated robot."""
    console.print_text(
        "a simulated cable-driven robot, freshly switched on: where it believes its tip to be, and "
        "corrected by the shipped network, against the exact truth"
    )
    rows = [
        (f"{name} position, mm", score.rms_mm, score.p95_mm)
        for name, score in (("reported", found.before), ("corrected", found.after))
    ]
    console.print_table(("error", "RMS", "95 % below"), rows)

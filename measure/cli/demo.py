"""`measure demo`: the whole way once, without any hardware."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry
from measure.neighbours import load_command


def demo(
    *,
    out: OutFile = Path("triball-demo"),
    overwrite: Overwrite = False,
    profile: str = "precise",
    frames: int = 30,
    studio: bool = False,
    board: str = "charuco_8x5_27",
    no_board: bool = False,
    port: int = 8080,
    browser: Annotated[bool, Parameter(negative="--no-browser")] = True,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Render a session, measure it, compare with the truth; correct a simulated robot.

    Four webcams look at three balls that move. The pictures have lens distortion, blur, a colour
    mosaic, noise and JPEG artefacts; where the balls really were is known exactly. Then the second
    half of the way: the shipped network corrects a simulated robot's position, without a camera.

    With `--studio` four rendered cameras are served to the set-up page instead, on a new folder in
    `--out`: a board is waved before them until the folder has a calibration, then it lies still
    until that has a world (or a body), then the body moves. With `--no-board` the body itself is
    waved, and then lies still. It runs until interrupted (Ctrl-C).

    Args:
        out: folder for the session and the run.
        profile: how to measure: `precise`, `paper`, or the path of a profile of your own (.toml).
        frames: frame sets to render.
        studio: try the set-up page with rendered cameras.
        board: the waved board: `charuco_8x5_27` or `chessboard_9x6_25`.
        no_board: wave the body itself instead of a board.
        port: of the set-up page; 0 for any that is free.
        browser: open the set-up page in a browser.
    """
    if studio:
        serve = load_command("studio")
        waved = "body" if no_board else board
        serve(out, port=port, browser=browser, rendered=waved, registry=registry)
        return
    chosen = api.load_profile(profile)
    with console.progress("rendering and measuring", "steps") as report:
        made = api.demo(out, chosen, registry, frames, report, overwrite)
    if json:
        values = dataclasses.asdict(made) | {"profile": chosen.name}
        added = {name: one["values"] for name, one in values.pop("additions").items()}
        console.print_json(values | added)
    else:
        _print(made)


def _print(made: api.Demo) -> None:
    """Print what was measured, what others add, and where to go on."""
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
    for addition in made.additions.values():
        console.print_text(addition.sentence)
        console.print_table(addition.columns, addition.rows)
    console.print_text(f"session  {made.session}")
    console.print_text(f"run      {made.run}  (poses.csv opens in any spreadsheet)")
    console.print_text(f"picture  {made.picture}")
    console.print_text(f"look at it in 3-D:     measure view {made.run}")
    console.print_text(f"every error in detail: measure evaluate {made.run}")

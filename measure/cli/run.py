"""`measure run`: a recorded session becomes poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.injected import InjectedRegistry
from measure.errors import ConfigError

if TYPE_CHECKING:
    from measure.api.many import Outcome


def run(
    *sessions: Path,
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
    spawn: bool = False,
    connect: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Measure a recorded session.

    Every frame set becomes a row of the run: `ok`, `flagged` (a pose to doubt), `lost` or
    `skipped` (no pose, and why). Several sessions are measured side by side.

    Args:
        sessions: the session's folder, or several; they are only read.
        out: the run's folder, made if it is not there; for several sessions, the folder of theirs.
        profile: `precise`, `paper`, or the path of a profile of your own (.toml).
        detector: a detector plugin to use instead of the profile's.
        triangulator: likewise.
        solver: likewise, a pose solver.
        set_: a setting as STAGE.NAME=VALUE, such as detector.rays=128; may be repeated.
        calibration: a calibration to use instead of the session's.
        body: a body file to use instead of the session's.
        images: pictures to keep in the viewer's recording: none, all, or every N-th set.
        recording: write run.rrd for the viewer.
        spawn: open the viewer at once and watch while it measures.
        connect: send to a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
        resume: go on with an interrupted run.
        overwrite: throw an earlier run in the folder away.
        workers: how many sessions to measure at a time; as many as there are cores.
        cluster: a dask scheduler's address, tcp://HOST:PORT, whose workers do the work.
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
        viewer=api.spawn_viewer() if spawn else connect,
        resume=resume,
        overwrite=overwrite,
        calibration=calibration,
        body=body,
    )
    if not sessions:
        raise ConfigError("no session to measure: give its folder")
    if len(sessions) > 1 or cluster is not None:
        with console.progress("measuring", "recordings") as report:
            outcomes = api.run_many(
                sessions, out, chosen, registry, options, workers, cluster, report
            )
        return _print_outcomes(outcomes, out, json)
    with console.progress("measuring") as report:
        summary = api.run(sessions[0], out, chosen, registry, options, report)
    if json:
        console.print_json({"run": str(out), **summary.values()})
        return 0
    console.print_text(summary.sentence())
    for reason, count in summary.reasons.items():
        console.print_text(f"  {count} x {reason}")
    for note in summary.notes:
        console.print_text(f"note: {note}")
    if not summary.ok:
        console.print_text(f"to find out why: measure check {sessions[0]}")
    console.print_text(f"written to {out}; look at it with: measure view {out}")
    return 0


def _print_outcomes(outcomes: Sequence[Outcome], out: Path, json: bool) -> int:
    """Say how every recording ended; 0 if all were measured, else as the worst of them."""
    if json:
        console.print_json(
            {
                "runs": [
                    {"session": o.session, "run": o.run, "error": o.error or None}
                    | (o.summary.values() if o.summary is not None else {})
                    for o in outcomes
                ]
            }
        )
    else:
        console.print_table(
            ("session", "frame sets", "ok", "flagged", "lost", "skipped", "sd mm", "failed"),
            [_row(outcome) for outcome in outcomes],
        )
        for outcome in outcomes:
            for note in outcome.summary.notes if outcome.summary is not None else ():
                console.print_text(f"note on {outcome.session.name}: {note}")
        console.print_text(f"written to {out}")
    for outcome in outcomes:
        if outcome.defect:
            print(outcome.defect, file=sys.stderr)
    if any(outcome.defect for outcome in outcomes):
        return 1
    return 2 if any(outcome.error for outcome in outcomes) else 0


def _row(outcome: Outcome) -> tuple[object, ...]:
    s = outcome.summary
    if s is None:
        return (outcome.session.name, None, None, None, None, None, None, outcome.error)
    return (
        outcome.session.name,
        s.frame_sets,
        s.ok,
        s.flagged,
        s.lost,
        s.skipped,
        s.position_sd_mm,
        None,
    )

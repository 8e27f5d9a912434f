"""`measure run`: a recorded session becomes poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from measure import api
from measure.api.many import Outcome
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import BodyOptions, InjectedRegistry, ProfileOptions, ViewerOptions
from measure.errors import ConfigError
from measure.limits import MOST_LISTED
from measure.measuring.kept_rig import Keep
from measure.results import Summary
from measure.results.summary import WHICH_ACCURACY


@Parameter(name="*")
@dataclass(frozen=True)
class _ExecutionOptions:
    """What happens to earlier runs, and where the work is done.

    Attributes:
        resume: continue an interrupted run: its rows stay, the rest is measured.
        workers: how many processes measure several sessions side by side, as many as there are
            cores if omitted; or stretches of a long one, which this process measures if omitted.
        cluster: a dask scheduler's address, tcp://HOST:PORT, whose workers do so instead.
        keep_calibration: if omitted, a camera that is moved meanwhile is left out and brought back;
            `follow` also follows one that drifts; `warn` only names it; `off` measures with it as
            it is.
    """

    resume: bool = False
    overwrite: Overwrite = False
    workers: int | None = None
    cluster: str | None = None
    keep_calibration: Keep | None = None


def run(
    *sessions: Path,
    out: OutFile,
    method: ProfileOptions = ProfileOptions(),
    calibration: Path | None = None,
    bodies: BodyOptions = BodyOptions(),
    viewer: ViewerOptions = ViewerOptions(),
    execution: _ExecutionOptions = _ExecutionOptions(),
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Measure a recorded session.

    Every frame set becomes a row of the run: `ok`, `flagged` (a pose to doubt), `lost` or
    `skipped` (no pose, and why). Several sessions are measured side by side.

    Args:
        sessions: the session's folder, or several; they are only read.
        out: the run's folder, made if it is not there; for several sessions, the folder of theirs.
        calibration: a calibration to use instead of the session's.
    """
    chosen = method.chosen()
    options = api.RunOptions(
        image_every=api.parse_images(viewer.images),
        recording=viewer.recording,
        viewer=viewer.address(),
        resume=execution.resume,
        overwrite=execution.overwrite,
        calibration=calibration,
        body=bodies.body or None,
        reference=bodies.reference,
        keep_calibration=execution.keep_calibration,
    )
    if not sessions:
        raise ConfigError("no session to measure: give its folder")
    workers = api.Workers(execution.workers, execution.cluster)
    if len(sessions) > 1:
        with console.progress("measuring", "recordings") as report:
            outcomes = api.run_many(sessions, out, chosen, registry, options, workers, report)
        return _print_outcomes(outcomes, out, json)
    with console.progress("measuring") as report:
        if workers == api.Workers():
            summary = api.run(sessions[0], out, chosen, registry, options, report, console.note)
        else:
            summary = api.run_in_stretches(
                sessions[0], out, chosen, registry, options, workers, report, console.note
            )
    _print_one(summary, sessions[0], out, json)
    return 0


def _print_one(summary: Summary, session: Path, out: Path, json: bool) -> None:
    if json:
        console.print_json({"run": str(out), **summary.values()})
        return
    print_summary(summary)
    if not summary.ok:
        console.print_text(f"to find out why: measure check {session}")
    console.print_text(f"written to {out}; look at it with: measure view {out}")


def print_summary(summary: Summary) -> None:
    """Print a run's summary, the reasons for missing poses, and the notes."""
    console.print_text(summary.sentence())
    if summary.ok:
        console.print_text(f"  {WHICH_ACCURACY['stated']}")
    for name, one in summary.bodies.items():
        console.print_text(f"  {name}: {one.sentence()}")
    reasons = list(summary.reasons.items())
    for reason, count in reasons[:MOST_LISTED]:
        console.print_text(f"  {count} x {reason}")
    if len(reasons) > MOST_LISTED:
        more = len(reasons) - MOST_LISTED
        console.print_text(f"  and {more} rarer kinds, which summary.json lists")
    for note in summary.notes:
        console.print_text(str(note))


def _print_outcomes(outcomes: Sequence[Outcome], out: Path, json: bool) -> int:
    """Print the outcome of every recording; returns the exit code of the worst."""
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
                console.print_text(f"{note.level} on {outcome.session.name}: {note.text}")
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
        return (outcome.session.name, *[None] * 6, outcome.error)
    counts = (s.frame_sets, s.ok, s.flagged, s.lost, s.skipped)
    return (outcome.session.name, *counts, s.position_sd_mm, None)

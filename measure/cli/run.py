"""`measure run`: a recorded session becomes poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from measure import api
from measure.api.many import Outcome
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile
from measure.cli.options import FIELDS, InjectedRegistry, ProfileOptions, Recording, Spawn, viewer
from measure.errors import ConfigError
from measure.limits import MOST_LISTED
from measure.results import Summary
from measure.results.summary import WHICH_ACCURACY


@FIELDS
@dataclass(frozen=True)
class _RunOptions(api.RunOptions):
    recording: Recording = True


def run(
    *sessions: Path,
    out: OutFile,
    method: ProfileOptions = ProfileOptions(),
    spawn: Spawn = False,
    options: _RunOptions = _RunOptions(),
    workers: Annotated[api.Workers, FIELDS] = api.Workers(),
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> int:
    """Measure a recorded session.

    Every frame set becomes a row of the run: `ok`, `flagged` (a pose to doubt), `lost` or
    `skipped` (no pose, and why). Several sessions are measured side by side.

    Args:
        sessions: the session's folder, or several; they are only read.
        out: the run's folder, made if it is not there; for several sessions, the folder of theirs.
    """
    chosen = method.chosen()
    options = replace(options, connect=viewer(options.connect, spawn))
    if not sessions:
        raise ConfigError("no session to measure: give its folder")
    if len(sessions) > 1:
        with console.progress("measuring", "recordings") as report:
            outcomes = api.run_many(sessions, out, chosen, registry, options, workers, report)
        return _print_outcomes(outcomes, out, json)
    with console.progress("measuring") as report:
        given = sessions[0], out, chosen, registry, options
        if workers == api.Workers():
            summary = api.run(*given, report, console.note)
        else:
            summary = api.run_in_stretches(*given, workers, report, console.note)
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

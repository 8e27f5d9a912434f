"""The acceptance test: a run's rests, or its balls, against known lengths."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from measure.api.outputs import output
from measure.arrays import Floats
from measure.errors import DegenerateGeometryError, RunError
from measure.metrology.rests import Rests
from measure.reading import read_text
from measure.results import Run, read_runs
from measure.results.distances import BallDistance, origin_distance
from measure.results.pose_table import rests_of
from measure.results.run import one_of
from measure.tables import NumberTable, read_number_table
from measure_lab.api.metrology import told_of
from measure_lab.lengths import Acceptance, MeasuredLengths, between_rests, judge


@dataclass(frozen=True, eq=False)
class Accepted:
    """An acceptance test."""

    judged: Acceptance
    promises: tuple[tuple[str, bool, str], ...]  # what the program promises, whether it held, how


def accept(
    run: Path | str,
    lengths: Path | str,
    out: Path | None = None,
    body: str | None = None,
    overwrite: bool = False,
) -> Accepted:
    """Test a rig by known lengths: its errors against its stated uncertainty.

    The command's exit code is 3 where lengths contradict what the rig states of itself, 0
    otherwise.

    Args:
        run: a run in which the body stood still at the ends of known lengths.
        lengths: table from,to,length_mm between rests by their numbers (`measure rests`) or between
            two balls by their names or two bodies by theirs (a ball bar), one of them the run's
            reference; perhaps with sd_mm, how exactly a length is known.
        out: report to write, one HTML file.
        body: which body, of a run of several.

    Raises:
        RunError: no run, or a row that names no rest and no ball.
    """
    with output(out, overwrite) as file:
        opened, accepted = _accepted(Path(run), Path(lengths), body)
        if out is not None:
            from measure_lab.acceptance_report import acceptance_report

            file.write_text(acceptance_report(opened, accepted.judged, accepted.promises), "utf-8")
    return accepted


def _accepted(folder: Path, path: Path, body: str | None) -> tuple[Run, Accepted]:
    table, runs = _read(path), read_runs(folder)
    ends = [*zip(table.words["from"], table.words["to"], strict=True)]
    bodies = frozenset(one.body.name for one in runs if one.several)
    only_bodies = all({*pair} <= bodies for pair in ends)
    opened = runs[0] if only_bodies and body is None else one_of(runs, folder, body)
    rests = rests_of(opened)
    order, measured = _measure(path, zip(table.lines, ends, strict=True), opened, rests, bodies)
    known = table.columns["length_mm"]
    sd = table.columns.get("sd_mm", np.zeros(len(known)))
    names = [" - ".join(ends[k]) for k in order]
    judged = judge(
        names, measured, known[order], sd[order], tuple(one.text for one in opened.contradictions)
    )
    return opened, Accepted(judged, _promises(judged, opened, rests))


def _read(path: Path) -> NumberTable:
    sd = ("sd_mm",) if "sd_mm" in read_text(path, RunError).partition("\n")[0] else ()
    needed = ("length_mm", *sd)
    table = read_number_table(path, needed, error=RunError, words=("from", "to"))
    for line, length, *sds in zip(table.lines, *table.columns.values(), strict=True):
        if not 0 < length < math.inf:
            raise RunError(f"{path}:{line}: length_mm is {length:g}: write a length in mm")
        if not all(0 <= given < math.inf for given in sds):
            raise RunError(f"{path}:{line}: sd_mm is {sds[0]:g}: write a standard deviation in mm")
    return table


def _measure(
    path: Path,
    rows: Iterable[tuple[int, tuple[str, str]]],
    run: Run,
    rests: Rests,
    bodies: frozenset[str],
) -> tuple[list[int], MeasuredLengths]:
    """The lengths of a table's rows (line, ends), and of each its row: between rests first."""
    balls = {frozenset(one.balls): one for one in run.distances if one.count}
    pairs: list[tuple[int, int]] = []
    seen: list[_Seen] = []
    order: list[int] = []
    for row, (line, ends) in enumerate(rows):
        with told_of(f"{path}:{line}"):
            if frozenset(ends) in balls:
                found = [_Seen.whole(balls[frozenset(ends)], run)]
            elif {*ends} <= bodies:
                found = _of_bodies(ends, run, rests)
            else:
                order.insert(len(pairs), row)
                pairs.append(_numbers(ends, rests, run))
                continue
        seen += found
        order += [row] * len(found)
    return order, _with_seen(between_rests(rests, pairs), seen)


def _numbers(ends: tuple[str, str], rests: Rests, run: Run) -> tuple[int, int]:
    """The numbers of two rests."""
    if not all(end.isdigit() for end in ends):
        raise DegenerateGeometryError(
            f"'{ends[0]}' to '{ends[1]}' are no two rests (numbers, see measure rests) and no two "
            f"balls or bodies that were seen (of {', '.join(run.body.names)})"
        )
    first, second = map(int, ends)
    if rests.rest(first) is rests.rest(second):
        raise DegenerateGeometryError(f"rest {first} has no distance from itself: give two rests")
    return first, second


@dataclass(frozen=True, eq=False)
class _Seen:
    """A length that is seen at every instant: between two balls, or two bodies."""

    distance: BallDistance
    middle_mm: Floats  # (3,) where, in the world

    @classmethod
    def whole(cls, distance: BallDistance, run: Run) -> _Seen:
        """Over a whole run."""
        return cls(distance, np.mean(run.world_from_body.apply(run.body.middle), axis=0))


def _of_bodies(ends: tuple[str, str], run: Run, rests: Rests) -> list[_Seen]:
    """The distance of two bodies' origins at every rest; over the whole run if there is none."""
    table = run.relative()
    pairs = (ends, ends[::-1])
    found = next((d for a, b in pairs if (d := origin_distance(table, a, b)).count), None)
    if found is None:
        raise DegenerateGeometryError(
            f"'{ends[0]}' and '{ends[1]}' have no relative pose to rely on: one must be the run's "
            "reference, and both unflagged"
        )
    parts = []
    for rest in rests.rests:
        here = (run.times_s >= rest.start_s) & (run.times_s <= rest.end_s)
        measured = np.where(here, found.measured_mm, np.nan)
        if np.isfinite(measured).any():
            part = replace(found, measured_mm=measured, sd_mm=np.where(here, found.sd_mm, np.nan))
            parts.append(_Seen(part, rest.world_from_body.translation))
    return parts or [_Seen.whole(found, run)]


def _with_seen(found: MeasuredLengths, seen: Sequence[_Seen]) -> MeasuredLengths:
    """The lengths, and behind them those that are seen at every instant."""
    if not seen:
        return found
    # They share balls, light and rays: half of their variance counts as common.
    sd = np.array([one.distance.uncertainty_mm for one in seen])
    middles, single = zip(
        *((one.middle_mm, np.nanstd(one.distance.measured_mm)) for one in seen), strict=True
    )
    return MeasuredLengths(
        np.concatenate([found.lengths_mm, [one.distance.mean_mm for one in seen]]),
        block_diag(found.covariance, np.outer(sd, sd) * (1 + np.eye(len(sd))) / 2),
        np.concatenate([found.middles_mm, middles]),
        np.concatenate([found.single_sd_mm, single]),
    )


def _promises(judged: Acceptance, run: Run, rests: Rests) -> tuple[tuple[str, bool, str], ...]:
    """What the program says of itself, and whether it held here."""
    n, inside = len(judged.ratios), int(np.sum(np.abs(judged.ratios) <= 1))
    scale = f"{100 * judged.scale:+.3f} %, U = {100 * judged.scale_expanded:.3f} % (k = 2)"
    out = [
        ("lengths err within their uncertainty", not judged.beyond.any(),
         f"{inside} of {n} within U (k = 2)"),
        ("the scale is right", abs(judged.scale) <= judged.scale_expanded, scale),
        ("ball distances agree with the body file", not run.contradictions,
         "; ".join(map(str, run.contradictions)) or "no contradiction"),
        ("poses are not in doubt", not run.summary.flagged,
         f"{run.summary.flagged} of {run.summary.frame_sets} flagged, and left out"),
    ]  # fmt: skip
    if len(rests):
        scatter = f"{100 * math.sqrt(rests.noise_share):.0f} % of the stated standard deviation"
        out.append(("poses at rest scatter no more than stated", rests.noise_share <= 1, scatter))
    return tuple(out)

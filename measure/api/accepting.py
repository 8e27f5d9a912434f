"""The acceptance test: a run's rests, or its balls, against known lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from measure.api.metrology import told_of
from measure.api.outputs import check_page_writable
from measure.errors import DegenerateGeometryError, RunError
from measure.metrology.lengths import Acceptance, MeasuredLengths, between_rests, judge
from measure.metrology.rests import Rests
from measure.reading import read_text
from measure.results import Run, read_run
from measure.results.distances import BallDistance
from measure.results.pose_table import rests_of
from measure.session.number_table import NumberTable, read_number_table


@dataclass(frozen=True, eq=False)
class Accepted:
    """An acceptance test."""

    judged: Acceptance
    promises: tuple[tuple[str, bool, str], ...]  # what the program promises, whether it held, how


def accept(
    run: Path | str, lengths: Path | str, page: Path | None = None, body: str | None = None
) -> Accepted:
    """Compare lengths of a run with known ones.

    Args:
        run: the run's folder.
        lengths: a table `from,to,length_mm` and perhaps `sd_mm`, between rests by their numbers or
            between two balls of the body by their names.
        page: a report to write.
        body: the name of the body that rests, in a run of several.

    Raises:
        RunError: no run, or a row that names no rest and no ball.
        ConfigError: the page cannot be written.
    """
    path = Path(lengths)
    opened, table = read_run(Path(run), body), _read(path)
    if page is not None:
        check_page_writable(page)
    rests = rests_of(opened)
    balls = {frozenset(one.balls): one for one in opened.distances if one.count}
    pairs: list[tuple[int, int]] = []
    seen, order = [], []
    rows = zip(table.lines, table.words["from"], table.words["to"], strict=True)
    for row, (line, *ends) in enumerate(rows):
        with told_of(f"{path}:{line}"):
            if frozenset(ends) in balls:
                seen.append(balls[frozenset(ends)])
                order.append(row)
            else:
                order.insert(len(pairs), row)
                pairs.append(_numbers(ends, rests, opened))
    names = [f"{table.words['from'][k]} - {table.words['to'][k]}" for k in order]
    known = table.columns["length_mm"]
    sd = table.columns.get("sd_mm", np.zeros(len(known)))
    found = _with_balls(between_rests(rests, pairs), opened, seen)
    judged = judge(names, found, known[order], sd[order], opened.contradictions)
    promises = _promises(judged, opened, rests)
    if page is not None:
        from measure.viewing.report.acceptance_report import acceptance_report

        page.write_text(acceptance_report(opened, judged, promises), "utf-8")
    return Accepted(judged, promises)


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


def _numbers(ends: list[str], rests: Rests, run: Run) -> tuple[int, int]:
    """The numbers of two rests."""
    if not all(end.isdigit() for end in ends):
        raise DegenerateGeometryError(
            f"'{ends[0]}' to '{ends[1]}' are no two rests (numbers, see measure rests) and no two "
            f"balls that were seen (of {', '.join(run.body.names)})"
        )
    first, second = map(int, ends)
    if rests.rest(first) is rests.rest(second):
        raise DegenerateGeometryError(f"rest {first} has no distance from itself: give two rests")
    return first, second


def _with_balls(found: MeasuredLengths, run: Run, seen: Sequence[BallDistance]) -> MeasuredLengths:
    """The lengths, and behind them distances between balls by rays alone."""
    if not seen:
        return found
    # They share balls, light and rays: half of their variance counts as common.
    sd = np.array([one.uncertainty_mm for one in seen])
    middle = np.mean(run.world_from_body.apply(run.body.middle), axis=0)
    return MeasuredLengths(
        np.concatenate([found.lengths_mm, [one.mean_mm for one in seen]]),
        block_diag(found.covariance, np.outer(sd, sd) * (1 + np.eye(len(sd))) / 2),
        np.concatenate([found.middles_mm, np.tile(middle, (len(seen), 1))]),
        np.concatenate([found.single_sd_mm, [np.nanstd(one.measured_mm) for one in seen]]),
    )


def _promises(judged: Acceptance, run: Run, rests: Rests) -> tuple[tuple[str, bool, str], ...]:
    """What the program says of itself, and whether it held here."""
    n, inside = len(judged.ratios), int(np.sum(np.abs(judged.ratios) <= 1))
    off = [line for line in judged.contradictions if line.startswith("length")]
    scale = f"{100 * judged.scale:+.3f} %, U = {100 * judged.scale_expanded:.3f} % (k = 2)"
    out = [
        ("lengths err within their uncertainty", not off, f"{inside} of {n} within U (k = 2)"),
        ("the scale is right", abs(judged.scale) <= judged.scale_expanded, scale),
        ("ball distances agree with the body file", not run.contradictions,
         "; ".join(run.contradictions) or "no contradiction"),
        ("poses are not in doubt", not run.summary.flagged,
         f"{run.summary.flagged} of {run.summary.frame_sets} flagged, and left out"),
    ]  # fmt: skip
    if len(rests):
        scatter = f"{100 * math.sqrt(rests.noise_share):.0f} % of the stated standard deviation"
        out.append(("poses at rest scatter no more than stated", rests.noise_share <= 1, scatter))
    return tuple(out)

"""The tables of the benchmark: a row for every method on every recording."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.methods import METHODS
from benchmarks.trial import Trial, bounds_of, run_trial
from measure.host import Registry
from measure.session import open_session, read_trajectory

Rows = list[tuple[str, ...]]
FIGURES = (
    "centre px",
    "position mm",
    "rotation deg",
    "x bound",
    "no pose %",
    "wrong %",
    "flagged %",
    "in 95 %",
    "first x",
    "later x",
)


def measured_rows(name: str, path: Path, methods: str) -> Rows:
    """Rows of a recording, by every method whose name contains `methods`: name and figures."""
    cv2.setNumThreads(1)
    registry = Registry.discover()
    truth = read_trajectory(path / "truth.csv")
    with open_session(path) as session:
        bounds = bounds_of(session, truth)
    rows: Rows = []
    for method in METHODS:
        if methods in method.name:
            with open_session(path) as session:
                trial = run_trial(method, session, truth, registry, bounds)
            rows.append((method.name, *_cells(trial)))
            print("  ".join((name, *rows[-1])), file=sys.stderr, flush=True)
    return rows


def _cells(trial: Trial) -> tuple[str, ...]:
    return (
        f"{trial.center_px:.3f}",
        f"{trial.position_mm:.3f}",
        f"{trial.rotation_deg:.3f}",
        f"{trial.over_bound:.0f}",
        f"{100 * trial.missing:.0f}",
        f"{100 * trial.wrong:.0f}",
        f"{100 * trial.flagged:.0f}",
        f"{100 * trial.covered:.0f}",
        f"{trial.first_ref:.1f}",
        f"{trial.later_ref:.1f}",
    )


def typical(rows: Rows, of: str = "") -> Rows:
    """A row for every method in rows (recording, method, figures): what is typical of all of them.

    Geometric means, for what is twice as far off in one scene may be half as far off in another;
    plain means of shares.

    Args:
        rows: recording, method and figures.
        of: what the recordings have in common.
    """
    out: Rows = []
    for method in dict.fromkeys(row[1] for row in rows):
        figures = np.array([row[2:] for row in rows if row[1] == method], dtype=np.float64)
        cells = []
        for name, column, text in zip(FIGURES, figures.T, rows[0][2:], strict=True):
            with np.errstate(divide="ignore"):
                mean = np.mean(column) if name.endswith("%") else np.exp(np.mean(np.log(column)))
            cells.append(f"{mean:.{len(text.partition('.')[2])}f}")
        count = f"typical of {len(figures)}"
        out.append((f"{of} ({count})" if of else count, method, *cells))
    return out


def typical_by(rows: Rows, kind: Callable[[str], str]) -> Rows:
    """What is typical of each kind of recording, and of all; one alone in its kind stays."""
    kinds: dict[str, Rows] = {}
    for row in rows:
        kinds.setdefault(kind(row[0]), []).append(row)
    out: Rows = []
    for name, group in kinds.items():
        out += typical(group, name) if len({row[0] for row in group}) > 1 else group
    return out + typical(rows)


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells in Markdown, the first column flush left."""
    lines = [tuple(head), tuple("---" if i < 1 else "---:" for i in range(len(head))), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"

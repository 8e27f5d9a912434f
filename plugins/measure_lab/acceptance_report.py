"""The page of an acceptance test, to be filed."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import plotly.graph_objects as go

from measure.results import Run
from measure.viewing.report import figures
from measure.viewing.report.page import Page
from measure_lab.lengths import Acceptance

_HOW = (
    "Lengths between places at which the body stood still, or between its balls, less the known "
    "ones, after VDI/VDE 2634 part 1 and ASTM E3064 in spirit. U is the expanded uncertainty that "
    "the program states of a length (two standard deviations, the known length's own included). "
    "One of so many lengths contradicts it beyond {limit:.2f} standard deviations, which a rig as "
    "good as it says exceeds in one of 20 tests."
)


def acceptance_report(
    run: Run, judged: Acceptance, promises: Sequence[tuple[str, bool, str]]
) -> str:
    """The report as HTML; `promises` are what the program promises, whether it held, and how."""
    wrong = judged.contradictions
    tone = "bad" if wrong else "good" if all(held for _, held, _ in promises) else "doubtful"
    verdict = f"Not accepted: {wrong[-1]}." if wrong else "Accepted."
    verdict += f" {judged.sentence}"
    page = Page(f"Acceptance test of {run.path.resolve().name}", verdict, tone)
    page.facts(_facts(run, judged))
    rows = [
        (name, *(float(value) for value in row), *(str(round(x)) for x in middle.tolist()))
        for name, middle, *row in zip(
            judged.names, judged.middles_mm, judged.known_mm, judged.length_errors_mm,
            judged.expanded_mm, judged.ratios, strict=True,
        )
    ]  # fmt: skip
    columns = ("from - to", "length mm", "error mm", "U mm", "error / U", "x mm", "y mm", "z mm")
    page.table("Lengths", _HOW.format(limit=judged.limit), columns, rows)
    page.figures(
        "Errors",
        "Measured minus known, with U (k = 2) as bars about zero: over length, and along each axis "
        "where the middle of the length was.",
        _errors(judged, judged.known_mm, "length [mm]"),
        *(_errors(judged, judged.middles_mm[:, axis], f"{'xyz'[axis]} [mm]") for axis in range(3)),
    )
    page.table(
        "What the program promises",
        "Whether it held in this recording.",
        ("promise", "held", "here"),
        [(what, "yes" if held else "no", how) for what, held, how in promises],
    )
    figures.add_cameras(page, "The cameras as used.", run.cameras)
    return page.render("Made by measure accept. Everything on this page is inside this file.")


def _facts(run: Run, judged: Acceptance) -> list[tuple[str, str]]:
    scale = f"{100 * judged.scale:+.3f} ± {100 * judged.scale_expanded:.3f} %"
    return [
        ("lengths", str(len(judged.known_mm))),
        ("length error, RMS", f"{judged.rms_mm:.3f} mm"),
        ("length error, largest", f"{judged.max_mm:.3f} mm"),
        (judged.repeated_words, f"{judged.repeatability_mm:.3f} mm"),
        ("scale, U with k = 2", scale),
        ("cameras", str(len(run.cameras))),
        ("written", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"),
        *(
            [("recorded as", name)]
            if (name := run.provenance.get("session", {}).get("name"))
            else []
        ),
    ]


def _errors(judged: Acceptance, at: np.ndarray, label: str) -> go.Figure:
    """Errors with their uncertainties, against one coordinate."""
    figure = figures.blank(300, label, "error [mm]", showlegend=False)
    zero, marks = np.zeros(len(at)), {"color": figures.INK, "size": 3}
    bars = {"type": "data", "array": judged.expanded_mm, "color": figures.INK, "thickness": 1}
    figure.add_scatter(x=at, y=zero, mode="markers", error_y=bars, hoverinfo="skip", marker=marks)
    colors = [figures.GOOD if abs(r) <= 1 else figures.BAD for r in judged.ratios]
    errors, dots = judged.length_errors_mm, {"color": colors, "size": 8}
    figure.add_scatter(x=at, y=errors, mode="markers", text=list(judged.names), marker=dots)
    return figure

"""An estimator's report: what it was trained on, how it learnt, and what it does to the error."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go

from measure.host.dataset import recording_of
from measure.viewing.report import figures
from measure.viewing.report.page import Page
from measure_learning.core import Trained
from measure_learning.core.scores import EstimatorEvaluation, Score, speed_range

_TOO_SURE = 1.5
"""Errors larger than this many promised standard deviations make the verdict doubtful."""
_UNLIKE = 0.1  # So does a larger share of states that the estimator calls unfamiliar
_MADE_FROM = (
    "estimator", "settings", "seed", "robot", "data", "created", "triball", "revision", "python",
)  # fmt: skip
_SHOWN_S = 60.0  # How much of a test trajectory is drawn


def estimator_report(trained: Trained, card: Mapping[str, Any]) -> str:
    """The report as HTML."""
    result = trained.evaluation
    judged = judged_on(card["data"])
    tone, sentence = verdict(result, judged)
    sentence = f"{trained.promise} {sentence}"
    page = Page(f"{card['estimator']} for {card['robot']}", sentence, tone)
    left = trained.left_out
    facts = (
        []
        if left is None or not left.groups
        else [("left on new recordings", f"{left.after_mm:.2f} mm RMS")]
    )
    facts += [
        ("training labels", str(card["data"]["training"]["usable"])),
        (f"{trained.scored_on} labels", str(result.after.rows)),
        ("residual over promised SD", f"{result.consistency**0.5:.2f}"),
        ("flagged as unfamiliar", f"{result.unfamiliar:.2%}"),
    ]
    if turn := result.turn:
        changed = f"{turn.before_deg:.2f} to {turn.after_deg:.2f} deg RMS"
        facts.append(("rotation of the tip", changed))
    page.facts(facts)
    words = "Before and after the correction, per axis and in 3-D."
    page.figures(
        "RMS and standard deviation", words, _bars(result.before, result.after, "rms"),
        _bars(result.before, result.after, "sd"),
    )  # fmt: skip
    _add_errors(page, trained)
    if np.isfinite(trained.test.times_s).all():
        words = (
            "Measured, reported and corrected position of one trajectory, per axis, and how "
            "far the latter two are from what was measured."
        )
        page.figures("Over time", words, *_over_time(trained))
    if trained.curve:
        words = "RMS on validation trajectories after every pass, and the training loss."
        page.figures("Learning curve", words, _curve(trained))
    _tables(page, result, judged)
    _add_provenance(page, card)
    return page.render("Made by measure train. Everything on this page is inside this file.")


def _tables(page: Page, result: EstimatorEvaluation, judged: str) -> None:
    """Scores of the parts: every test trajectory, every range of speeds."""
    columns = ("trajectory", "labels", "RMS before", "RMS after", "SD before", "SD after")
    page.table(
        "By trajectory", f"In mm; {judged}.", columns,
        [(n, b.rows, b.rms_mm, a.rms_mm, b.sd_mm, a.sd_mm)
         for n, (b, a) in result.by_trajectory.items()],
    )  # fmt: skip
    page.table(
        "By speed", "Speed of the reported tip, mm/s; errors in mm.",
        ("speed", "labels", "RMS before", "RMS after"),
        [(speed_range(low, high), b.rows, b.rms_mm, a.rms_mm)
         for low, high, b, a in result.by_speed if b.rows],
    )  # fmt: skip


def judged_on(data: Mapping[str, Any]) -> str:
    """What the scored data are to the estimator, in words, by the card's data."""
    scored = data.get("test", data["validation"])
    names, learnt = set(scored["trajectories"]), set(data["training"]["trajectories"])
    if names & learnt:
        return "labels between those learnt from (not on unseen trajectories)"
    if scored["digest"] == data["validation"]["digest"]:
        return "trajectories that training was stopped by"
    if set(map(recording_of, names)) & set(map(recording_of, learnt)):
        return "unseen trajectories of the recordings learnt from"
    return "unseen trajectories"


def verdict(result: EstimatorEvaluation, judged: str = "unseen trajectories") -> tuple[str, str]:
    """Tone and sentence; one that promises too much is not good, however much it corrects."""
    moves = "falls" if result.rms_change < 0 else "rises"
    words = (
        f"On {judged} the error {moves} from {result.before.rms_mm:.2f} to "
        f"{result.after.rms_mm:.2f} mm RMS ({result.rms_change:+.1%}), its SD from "
        f"{result.before.sd_mm:.2f} to {result.after.sd_mm:.2f} mm ({result.sd_change:+.1%})."
    )
    doubts = []
    if (times := result.consistency**0.5) > _TOO_SURE:
        doubts.append(f"its errors are {times:.1f} times as large as it promises")
    if result.unfamiliar > _UNLIKE:
        doubts.append(f"it calls {result.unfamiliar:.0%} of the test unlike its training")
    tone = "good" if result.rms_change < -0.5 else "doubtful" if result.rms_change < 0 else "bad"
    if not doubts:
        return tone, words
    return "bad" if tone == "bad" else "doubtful", f"{words} But {' and '.join(doubts)}."


def _add_errors(page: Page, trained: Trained) -> None:
    """What was wrong, and what is left of it."""
    data = trained.test
    before = np.where(data.usable[:, None], data.errors_mm, np.nan)
    left = before - trained.estimates.errors_mm
    axes = ("x", "y", "z")
    page.figures(
        "Distribution of the error",
        "Before the correction, and what is left after it, per axis; all scored trajectories.",
        figures.histograms(before, axes, "error before [mm]", "labels"),
        figures.histograms(left, axes, "error after [mm]", "labels"),
    )


def _add_provenance(page: Page, card: Mapping[str, Any]) -> None:
    made_from = {key: card[key] for key in _MADE_FROM if card.get(key) is not None}
    page.text("How to repeat it", "", str(card.get("command", "")))
    page.text("Settings, data and versions", "", json.dumps(made_from, indent=2))


def _bars(before: Score, after: Score, kind: str) -> go.Figure:
    figure = figures.blank(y=f"{kind.upper()} [mm]", barmode="group")
    for name, score, color in (
        ("reported", before, figures.BAD), ("corrected", after, figures.GOOD)
    ):  # fmt: skip
        sizes = [*getattr(score, f"axis_{kind}_mm"), getattr(score, f"{kind}_mm")]
        figure.add_bar(x=["x", "y", "z", "3-D"], y=sizes, name=name, marker={"color": color})
    return figure


def _over_time(trained: Trained) -> list[go.Figure]:
    data = trained.test
    _, rows = next(data.runs())
    times = data.times_s[rows] - data.times_s[rows][0]
    shown = times < _SHOWN_S
    reported = data.reported_mm[rows][shown]
    curves = {
        "measured": reported + np.where(
            data.usable[rows][shown, None], data.errors_mm[rows][shown], np.nan),
        "reported": reported,
        "corrected": reported + trained.estimates.errors_mm[rows][shown],
    }  # fmt: skip
    colors = {"measured": figures.ACCENT, "reported": figures.BAD, "corrected": figures.GOOD}
    axes = [
        figures.over_time(
            times[shown], {name: values[:, axis] for name, values in curves.items()},
            f"{'xyz'[axis]} [mm]", colors,
        )
        for axis in range(3)
    ]  # fmt: skip
    away = {
        name: np.linalg.norm(curves[name] - curves["measured"], axis=1)
        for name in ("reported", "corrected")
    }
    return [*axes, figures.over_time(times[shown], away, "3-D error [mm]", colors)]


def _curve(trained: Trained) -> go.Figure:
    figure = figures.blank(x="pass", y="mm")
    epochs = [line.epoch for line in trained.curve]
    for name, values in (
        ("validation RMS", [line.validation_mm for line in trained.curve]),
        ("training loss", [line.train_mm for line in trained.curve]),
    ):
        figure.add_scatter(x=epochs, y=values, name=name, mode="lines")
    figure.update_yaxes(rangemode="tozero")
    return figure

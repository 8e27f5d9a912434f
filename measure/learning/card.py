"""Model cards: purpose, training data, accuracy and limits of a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from measure.learning.scores import speed_range


def write_card(path: Path, card: Mapping[str, Any]) -> None:
    """Write a model card as Markdown."""
    parts = (_origin(card), _scores(card["scores"]), _state(card["features"]), _LIMITS)
    path.write_text("\n\n".join("\n".join(lines) for lines in parts) + "\n", encoding="utf-8")


def _state(features: Sequence[tuple[str, str]]) -> list[str]:
    """Names and units of the features of a state, in the order in which they are sent."""
    return [
        "## A state",
        "",
        f"What `measure estimate` expects, {len(features)} numbers in this order:",
        "",
        ", ".join(f"`{name}`" + (f" {unit}" if unit else "") for name, unit in features),
    ]


_LIMITS = (
    "## Limits",
    "",
    "Valid for this robot, its cables as they were, and motions like those of the training.",
    "States beyond them are flagged as unfamiliar. After a restart a static offset may remain:",
    "`measure estimate --rezero` removes it. When the drift monitor warns, train again.",
)


def _origin(card: Mapping[str, Any]) -> list[str]:
    return [
        f"# {card['estimator']} for {card['robot']}",
        "",
        *([card["about"], ""] if "about" in card else []),
        "Corrects the reported tip position: add `error_mm` to it. The file holds normalisation,",
        "features, networks and state; `measure estimate` runs it, or any ONNX runtime.",
        "",
        f"- made by triball {card['triball']} (revision {card['revision']}), {card['created']}",
        *([f"- command: `{card['command']}`"] if "command" in card else []),
        f"- seed {card['seed']}; settings {card['settings']}",
        *(
            f"- {part}: {facts['usable']} labels in {len(facts['trajectories'])} trajectories, "
            f"digest {facts['digest']}"
            for part, facts in card["data"].items()
        ),
    ]


def _scores(scores: Mapping[str, Any]) -> list[str]:
    return [
        "## Error on the test trajectories, mm",
        "",
        "| | RMS | SD | 95 % | RMS x | RMS y | RMS z |",
        "|---|---|---|---|---|---|---|",
        _row("reported", scores["before"]),
        _row("corrected", scores["after"]),
        "",
        (
            f"RMS {scores['rms_change']:+.1%}, SD {scores['sd_change']:+.1%}. Residuals are "
            f"{scores['consistency'] ** 0.5:.2f} times as large as the reported covariance says"
        ),
        f"(1 is honest); {scores['unfamiliar']:.2%} of the states were flagged as unlike training.",
        "",
        "| test trajectory | labels | RMS before | RMS after |",
        "|---|---|---|---|",
        *(
            f"| {name} | {b['rows']} | {b['rms_mm']:.3f} | {a['rms_mm']:.3f} |"
            for name, (b, a) in scores["by_trajectory"].items()
        ),
        "",
        "| speed, mm/s | labels | RMS before | RMS after |",
        "|---|---|---|---|",
        *(
            f"| {speed_range(low, high)} | {b['rows']} | {b['rms_mm']:.3f} | {a['rms_mm']:.3f} |"
            for low, high, b, a in scores["by_speed"]
            if b["rows"]
        ),
    ]


def _row(name: str, score: Mapping[str, Any]) -> str:
    names = ("rms_mm", "sd_mm", "p95_mm")
    cells = [*(score[key] for key in names), *score["axis_rms_mm"]]
    return f"| {name} | " + " | ".join(f"{value:.3f}" for value in cells) + " |"

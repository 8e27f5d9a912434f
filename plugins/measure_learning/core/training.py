"""Fitting an estimator: split, fit, judge on unseen trajectories, save with a card."""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from measure.errors import EstimatorError
from measure.host import Dataset, Epoch, Estimator, LeftOut, Report
from measure.host.interfaces import RecordingLeftOut
from measure.host.registry import named
from measure_learning.core.scores import EstimatorEvaluation, Split, evaluate, fit, speed_range
from measure_learning.onnx import Estimates, OnnxModel
from measure_learning.onnx.model import contract


@dataclass(frozen=True, eq=False)
class Trained:
    """A fitted estimator on disk."""

    path: Path  # the ONNX file; the model card stands beside it
    evaluation: EstimatorEvaluation  # on the test trajectories, or those of validation
    scored_on: str  # which of the two
    left_out: LeftOut | None  # what is known of new recordings
    curve: tuple[Epoch, ...]  # the learning curve, if it was iterative
    test: Dataset
    estimates: Estimates  # of all their rows

    @property
    def promise(self) -> str:
        """What was shown of new recordings, in words."""
        return promise(self.left_out)


def train(
    estimator: Estimator,
    split: Split,
    out: Path,
    *,
    seed: int,
    report: Report,
    checkpoint: Path,
    resume: bool = False,
    notes: Mapping[str, str] | None = None,
) -> Trained:
    """Fit, evaluate and save.

    Args:
        split: training, validation (chooses and stops) and test trajectories (judged only here).
        out: the ONNX file to write; `OUT.card.md` and `OUT.card.json` go beside it.
        checkpoint: folder of what an interrupted fit leaves.
        resume: go on from where such a one got to.
        notes: further lines of the card.
    """
    if out.suffix != ".onnx":
        raise EstimatorError(f"{out}: a model's file name must end with .onnx")
    for what, part in (("training", split.train), (split.scored_on, split.test)):
        if part.usable.any() and not part.errors_mm[part.usable].any():
            raise EstimatorError(
                f"all errors of the {what} trajectories are 0: the robot needs no correction, or "
                "the labels are missing"
            )
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    if not resume:
        shutil.rmtree(checkpoint, ignore_errors=True)
    estimator.checkpoint = checkpoint
    fit(estimator, split.train, split.validation, seed=seed, report=report)
    trained = _save(estimator, split, out, _provenance(estimator, split, seed) | dict(notes or {}))
    shutil.rmtree(checkpoint, ignore_errors=True)
    return trained


def _save(estimator: Estimator, split: Split, out: Path, card: dict[str, Any]) -> Trained:
    """Write the network, judge the written file on the test part, add the scores to its card."""
    _write(estimator, out, card)
    model = OnnxModel.load(out)
    estimates = model.predict(split.test)
    evaluation = evaluate(split.test, estimates)
    card |= {"scores": asdict(evaluation)}
    _write(estimator, out, card)  # the same network, now with its scores inside
    features = [[feature.name, feature.unit] for feature in split.train.schema.features]
    said = contract(len(model.features), model.memory_size, model.period_s, turns=model.turns)
    curve = [asdict(line) for line in estimator.curve]
    full = card | {"features": features, "contract": said, "curve": curve}
    full |= {"findings": list(estimator.findings)}
    out.with_suffix(".card.json").write_text(json.dumps(full, indent=1) + "\n")
    write_card(out.with_suffix(".card.md"), full)
    return Trained(
        out, evaluation, split.scored_on, estimator.left_out, estimator.curve, split.test, estimates
    )


def _write(estimator: Estimator, out: Path, card: dict[str, Any]) -> None:
    with named("estimator", estimator, "saving"):
        estimator.save(out, card)


def _provenance(estimator: Estimator, split: Split, seed: int) -> dict[str, Any]:
    return {
        "estimator": estimator.name,
        "settings": estimator.config.model_dump(mode="json"),
        "robot": split.train.schema.robot,
        "seed": seed,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "triball": metadata.version("triball"),
        "revision": revision(),
        "python": platform.python_version(),
        "scored_on": split.scored_on,
        "left_out": None if estimator.left_out is None else asdict(estimator.left_out),
        "data": {
            part: {
                "digest": data.digest(),
                "rows": len(data),
                "usable": int(data.usable.sum()),
                "trajectories": list(data.present()),
            }
            for part, data in (
                ("training", split.train),
                ("validation", split.validation),
                (split.scored_on, split.test),
            )
        },
    }


def revision() -> str:
    """The git revision of this program's sources, or "released" where there is no repository.

    Sources that differ from their revision are called dirty: nobody can get them back.
    """
    here = Path(__file__).parent
    try:
        found = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude=*"],
            capture_output=True,
            text=True,
            check=True,
            timeout=5,
        )
    except (OSError, subprocess.SubprocessError):
        return "released"
    return found.stdout.strip()


def write_card(path: Path, card: Mapping[str, Any]) -> None:
    """Write a model card as Markdown."""
    scores, left_out, features = card["scores"], card["left_out"], card["features"]
    speeds = ((speed_range(low, high), b, a) for low, high, b, a in scores["by_speed"] if b["rows"])
    values = {
        "said_about": f"{card['about']}\n\n" if "about" in card else "",
        "said_command": f"- command: `{card['command']}`\n" if "command" in card else "",
        "said_data": "\n".join(
            f"- {part}: {facts['usable']} labels in {len(facts['trajectories'])} trajectories, "
            f"digest {facts['digest']}"
            for part, facts in card["data"].items()
        ),
        "promise": promise(left_out and _left_out(left_out)),
        "said_turns": _turns(left_out),
        "times": scores["consistency"] ** 0.5,
        "said_turn": _turn(scores.get("turn")),
        "trajectory_rows": _rows((n, b, a) for n, (b, a) in scores["by_trajectory"].items()),
        "speed_rows": _rows(speeds),
        "said_findings": "\n".join(
            ["## What the fit found", "", *(f"- {line}" for line in card["findings"]), "", ""]
        )
        if card.get("findings")
        else "",
        "count": len(features),
        "said_features": ", ".join(f"`{name}`" + (f" {u}" if u else "") for name, u in features),
    }
    form = Path(__file__).with_name("model_card.md").read_text("utf-8")
    path.write_text(form.format(**{**scores, **card, **values}), encoding="utf-8")


def _left_out(values: Mapping[str, Any]) -> LeftOut:
    turns = tuple(RecordingLeftOut(**turn) for turn in values["by_recording"])
    return LeftOut(**{**values, "by_recording": turns})


def _rows(scored: Iterable[tuple[str, Any, Any]]) -> str:
    return "\n".join(
        f"| {name} | {b['rows']} | {b['rms_mm']:.3f} | {a['rms_mm']:.3f} |" for name, b, a in scored
    )


def _turn(score: Mapping[str, Any] | None) -> str:
    """What becomes of the rotation; nothing where it is not corrected."""
    if score is None:
        return ""
    return (
        "Rotation of the tip, {rows} labels: {before_deg:.3f} deg RMS as reported, {after_deg:.3f} "
        "corrected; {inside_95:.1%} in the stated 95 % region.\n\n"
    ).format(**score)


def _turns(left_out: Mapping[str, Any] | None) -> str:
    """A table of the recordings left out in turn; nothing where there is none."""
    if not (turns := (left_out or {}).get("by_recording")):
        return ""
    lines = "\n".join(turns_table(turns))
    return (
        "Each recording by fits that have not seen it, and by the covariance that the others "
        f"left out give; errors and SD are RMS in 3-D, mm.\n\n{lines}\n\n"
    )


def turns_table(turns: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lines of a table of recordings that were left out in turn."""
    return [
        "| recording | labels | as reported | corrected | stated SD | in the 95 % region |",
        "|---|---:|---:|---:|---:|---:|",
        *(
            f"| {turn['name']} | {turn['labels']} | {turn['before_mm']:.3f} | "
            f"{turn['after_mm']:.3f} | {turn['stated_mm']:.3f} | {turn['inside_95']:.1%} |"
            for turn in turns
        ),
    ]


def promise(left_out: LeftOut | None) -> str:
    """What was shown of a recording that is not among those learnt from, in words."""
    if left_out is None:
        return "Nothing was shown: this estimator leaves no recordings out."
    change = f"{left_out.before_mm:.3f} mm RMS become {left_out.after_mm:.3f} mm"
    if left_out.groups:
        said = (
            f"{left_out.recordings} recordings, {left_out.groups} groups of them left out in turn: "
            f"{change}; the covariance is that of these residuals."
        )
        if not (shares := [turn.inside_95 for turn in left_out.by_recording]):
            return said
        return (
            f"{said} By the covariance that the others give, the 95 % region holds "
            f"{min(shares):.0%} to {max(shares):.0%} of each recording."
        )
    number = "one recording" if left_out.recordings == 1 else f"{left_out.recordings} recordings"
    return (
        f"Nothing is promised: learnt from {number}, none left out. On the validation trajectories "
        f"{change}, and the covariance is theirs: after a restart or on another day errors are "
        "larger than it says. Record several times, after a restart each."
    )

"""`measure train`: an estimator of a robot's position error."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from cyclopts import Parameter

from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite, shares
from measure.cli.options import InjectedRegistry, SettingTexts


@Parameter(name="*")
@dataclass(frozen=True)
class _SplitOptions:
    """How labels are kept for validation and test; fields of `measure.api.TrainOptions`.

    Attributes:
        validation: a data set of its own to choose and stop by, instead of a split.
        test: a data set of its own to score by.
        test_share: share of the labels kept for the test, in whole trajectories.
        validation_share: likewise for choosing and stopping.
        split_seed: which trajectories those are.
        folds: groups of recordings left out in turn, in fits of their own, to judge the covariance;
            0 leaves none out.
        split_rows: split by random rows, which is wrong: to see how wrong.
    """

    validation: Path | None = None
    test: Path | None = None
    test_share: float = 0.1
    validation_share: float = 0.1
    split_seed: int = 0
    folds: int = 4
    split_rows: bool = False


@Parameter(name="*")
@dataclass(frozen=True)
class _FitOptions:
    """What is trained, and from where; fields of `measure.api.TrainOptions` but for `set_`.

    Attributes:
        estimator: a plugin: stream (default), mlp (the paper's), ridge, gp, forest, offset.
        set_: one of its settings as NAME=VALUE, such as grus=2; may be repeated.
        seed: of everything random in training.
        resume: go on with an interrupted training.
    """

    estimator: str = "stream"
    set_: SettingTexts = ()
    seed: int = 0
    resume: bool = False


def train(
    data: tuple[Path, ...],
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    fit: _FitOptions = _FitOptions(),
    split: _SplitOptions = _SplitOptions(),
    about: str = "",
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Train an estimator of a robot's position error.

    Writes one ONNX file that holds everything needed to run it, and its model card. Whole
    recordings (trajectories, where there are not three) are kept for validation and for the test.

    Args:
        data: data sets made by `measure dataset`.
        out: the model's file (.onnx).
        about: a sentence for the model card.
    """
    from measure import api

    options = api.TrainOptions(
        estimator=fit.estimator,
        settings=api.parse_settings(fit.set_),
        seed=fit.seed,
        resume=fit.resume,
        overwrite=overwrite,
        **asdict(split),
        notes={"command": "measure " + shlex.join(sys.argv[1:])}
        | ({"about": about} if about else {}),
    )
    with console.progress(f"training {fit.estimator}", unit="per mille") as report:
        trained = api.train(data, out, options, registry, shares(report))
    result = trained.evaluation
    if json:
        known = trained.left_out and asdict(trained.left_out)
        said = {"model": str(out), "scored_on": trained.scored_on, "left_out": known}
        console.print_json(said | {"test": result.to_dict()})
        return
    names = ("", "RMS_mm", "SD_mm", "p95_mm", "x_mm", "y_mm", "z_mm")
    rows = [
        (name, score.rms_mm, score.sd_mm, score.p95_mm, *score.axis_rms_mm)
        for name, score in (("reported", result.before), ("corrected", result.after))
    ]
    console.print_table(names, rows)
    console.print_text(
        f"{trained.scored_on}: {result.after.rows} labels, RMS {result.rms_change:+.1%}, SD "
        f"{result.sd_change:+.1%}; written to {out}, with its card and report beside it"
    )
    console.note(trained.promise)

"""`measure train`: an estimator of a robot's position error."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, shares
from measure.cli.options import FIELDS, InjectedRegistry
from measure_learning import api


def train(
    data: tuple[Path, ...],
    /,
    *,
    out: OutFile,
    set_: tuple[str, ...] = (),
    options: Annotated[api.TrainOptions, FIELDS] = api.TrainOptions(),
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
        set_: a setting of the estimator as NAME=VALUE, such as grus=2; may be repeated.
        about: a sentence for the model card.
    """
    notes = {"command": "measure " + shlex.join(sys.argv[1:])}
    notes |= {"about": about} if about else {}
    with console.progress(f"training {options.estimator}", unit="per mille") as report:
        settings = api.parse_settings(set_)
        trained = api.train(data, out, options, registry, shares(report), settings, notes)
    result = trained.evaluation
    if json:
        known = trained.left_out and asdict(trained.left_out)
        said = {"model": str(out), "scored_on": trained.scored_on, "left_out": known}
        console.print_json(said | {"test": asdict(result)})
        return
    console.print_text(trained.promise)
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

"""`measure ablate`: which inputs an estimator needs."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.console import JsonFlag, shares
from measure.cli.options import InjectedRegistry
from measure.errors import ConfigError
from measure_learning import api


def ablate(
    files: tuple[Path, ...],
    /,
    *,
    single: bool = False,
    remove: bool = False,
    split_seed: int | None = None,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Find out which inputs an estimator needs.

    Every group of features is shuffled among the rows of the model's own test trajectories; with
    `--remove` the estimator is also fitted again without it.

    Args:
        files: all data sets that the model was trained on, and last the model.
        single: every feature on its own instead of the robot's groups.
        remove: also fit without each.
        split_seed: split the data anew instead of as in training, if they are others.
    """
    *data, model = files
    if not data:
        raise ConfigError(f"ablate {model}: expected data sets, and last the model")
    with console.progress("ablating", unit="per mille") as report:
        base, found = api.ablate(
            data,
            model,
            single=single,
            remove=remove,
            split_seed=split_seed,
            registry=registry,
            report=shares(report),
        )
    if split_seed is not None:
        console.note(
            f"split by --split-seed {split_seed}, not as in training: what the model learnt from "
            "may be among the test trajectories"
        )
    if json:
        console.print_json({"rms_mm": base, "inputs": found})
        return
    names = ("input", "features", "shuffled_mm", "removed_mm")
    rows = [(i.name, i.features, i.permutation_mm, i.removal_mm) for i in found]
    console.print_table(names, rows, title=f"RMS with all inputs: {base:.3f} mm; growth without:")

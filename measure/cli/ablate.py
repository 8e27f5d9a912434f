"""`measure ablate`: which inputs an estimator needs."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.console import JsonFlag, shares
from measure.cli.injected import InjectedRegistry


def ablate(
    data: Path,
    model: Path,
    /,
    *,
    single: bool = False,
    remove: bool = False,
    split_seed: int = 0,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Find out which inputs an estimator needs.

    Every group of features is shuffled among the test rows; with `--remove` the estimator is also
    fitted again without it.

    Args:
        data: the data set the model was trained on.
        model: the model.
        single: every feature on its own instead of the robot's groups.
        remove: also fit without each.
        split_seed: as in training, so that the test trajectories are unseen.
    """
    from measure import api

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
    if json:
        console.print_json({"rms_mm": base, "inputs": found})
        return
    names = ("input", "features", "shuffled_mm", "removed_mm")
    rows = [(i.name, i.features, i.permutation_mm, i.removal_mm) for i in found]
    console.print_table(names, rows, title=f"RMS with all inputs: {base:.3f} mm; growth without:")

"""`measure dataset`: robot states paired with measured position errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite, shares
from measure.cli.options import FIELDS
from measure.errors import ConfigError
from measure.host import Dataset
from measure_learning import api as learning_api
from measure_learning.core import AssemblySettings, TrajectoryFacts
from measure_learning.core.causes import LabelFacts


def dataset(
    runs: tuple[Path, ...] = (),
    /,
    *,
    out: OutFile,
    overwrite: Overwrite = False,
    known: Annotated[learning_api.RunFacts, FIELDS] = learning_api.RunFacts(),
    source: Annotated[learning_api.RobotLogs, FIELDS] = learning_api.RobotLogs(),
    assembly: Annotated[AssemblySettings, FIELDS] = AssemblySettings(),
    simulation: Annotated[
        learning_api.SimulationOptions, FIELDS
    ] = learning_api.SimulationOptions(),
    json: JsonFlag = False,
) -> None:
    """Pair a robot's states with measured position errors.

    Writes one Parquet file and a data card beside it. The offset between the clocks of cameras
    and robot is estimated from the motion; labels in doubt are kept but marked.

    Args:
        runs: run folders, or files of poses; without a log, tables that already hold errors.
        out: the data set's file (.parquet).
    """
    if bool(runs) == (simulation.simulate_min is not None):
        raise ConfigError("give runs, or --simulate-min MINUTES, but not both")
    read = (*runs, *source.robot_log, Path(source.robot), *filter(None, [known.frame]))
    with api.output(out, overwrite, read, [".card.json"]) as file:
        if not runs:
            with console.progress("simulating", unit="per mille") as report:
                data, facts = learning_api.simulate_dataset(file, simulation, shares(report))
        else:
            data, facts = learning_api.make_dataset(runs, source, file, assembly, known)
    labels = LabelFacts.of(data)
    if json:
        values = {"data": str(out), "rows": len(data), "labels": labels, "recordings": facts}
        console.print_json(values)
    else:
        _conclude(data, facts, assembly.clock_offset_s, out)
        _tell_labels(labels)


_COLUMNS = ("recording", "rows", "usable", "not measured", "no state", "outliers", "uncertain")


def _conclude(
    data: Dataset, facts: list[TrajectoryFacts], given_offset_s: float | None, out: Path
) -> None:
    """Print a table of the recordings; an estimated clock offset has an SD."""
    rows = [
        (
            *(f.name, f.rows, f.usable, f.not_measured, f.no_state, f.outliers, f.uncertain),
            *((f.clock.offset_s, f.clock.sd_s) if f.clock else (given_offset_s, None)),
        )
        for f in facts
    ]
    if rows:
        console.print_table((*_COLUMNS, "clock offset_s", "SD_s"), rows)
    for fact in facts:
        if fact.bad_states:
            console.note(
                f"{fact.name}: states of the robot's log that are left out, as they are not all "
                f"numbers: {fact.bad_states}"
            )
    console.print_text(
        f"{int(data.usable.sum())} labels in {len(data.present())} trajectories written to {out}"
    )


def _tell_labels(labels: LabelFacts | None) -> None:
    if labels is None:
        return
    mean, sd, largest = (
        " ".join(f"{value:.2f}" for value in values)
        for values in (labels.mean_mm, labels.sd_mm, labels.largest_mm)
    )
    console.print_text(
        f"labels, measured minus reported: {labels.rms_mm:.2f} mm RMS (3-D); in x y z mean {mean}, "
        f"SD {sd}, largest {largest} mm"
    )
    if labels.turns:
        console.print_text(
            f"{labels.turns} of them hold the tip's rotation, measured against the joints': "
            f"{labels.turn_deg:.2f} deg RMS"
        )

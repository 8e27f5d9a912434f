"""What is left of a tip's rotation error: `python -m benchmarks.rotation FOLDER [--real TABLES]`.

The simulated RAVEN-II learns from eight sessions and is judged by the truth after six other
restarts. A real arm is that of two tables, train and val, with commanded and measured joints
(`q1_cmd`, `q1_meas` and so on: rad, m) of a dVRK arm: its rotation is that of the measured joints.
Printed are the lines of the cards.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from benchmarks.command import run_command, run_measure
from measure_learning.onnx.rotation import turn_errors
from measure_learning.robots import find_schema

_CHECKOUT = Path(__file__).resolve().parents[1]
_SESSIONS = "--simulate-min 28 --pairs 8000 --restarts 8 --seed 1 --rotations"
_JUDGES = "--simulate-min 12 --pairs 3000 --restarts 6 --seed 101 --rotations --exact"
_EARLY = 12  # rows of a trajectory that are history only, where scored


def with_turns(table: pa.Table, *, scored: bool) -> pa.Table:
    """A table of labels with the errors of the rotation by its measured joints."""
    chain = find_schema("dvrk-psm").chain
    assert chain is not None
    commanded, measured = (
        np.stack([table[f"q{k}_{kind}"].to_numpy() for k in range(1, 7)], axis=1)
        * [1.0, 1.0, 1e3, 1.0, 1.0, 1.0]
        for kind in ("cmd", "meas")
    )
    known = np.isfinite(measured).all(axis=1)
    turns = np.full((len(known), 3), np.nan)
    poses = (chain.pose(q[known]).rotation for q in (measured, commanded))
    turns[known] = turn_errors(*poses)
    for axis, column in zip("xyz", turns.T, strict=True):
        table = table.append_column(f"turn_{axis}_rad", pa.array(column))
    if not scored:
        return table
    early = table["i"].to_numpy() < _EARLY
    words = np.where(early, "early", table["quality"].to_pylist())
    place = table.column_names.index("quality")
    return table.set_column(place, "quality", pa.array(words.tolist()))


def main() -> None:
    """Make the data, train and print."""
    parser = argparse.ArgumentParser(prog="benchmarks.rotation", description=__doc__)
    parser.add_argument("folder", type=Path, help="keeps data and models")
    parser.add_argument("--real", type=Path, help="a folder with train.parquet and val.parquet")
    parser.add_argument("--estimator", default="gp")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    sources = [_SESSIONS, _JUDGES]
    if given.real is not None:
        sources = []
        for name in ("train", "val"):
            table = parquet.read_table(given.real / f"{name}.parquet")
            parquet.write_table(
                with_turns(table, scored=name == "val"), given.folder / f"{name}_turns.parquet"
            )
            sources.append(f"{name}_turns.parquet --robot dvrk-psm")
    for source, out in zip(sources, ("learnt.parquet", "judge.parquet"), strict=True):
        words = ["dataset", *source.split(), "--out", out, "--overwrite"]
        run_measure(_CHECKOUT, given.folder, *words)
    role = "--test" if given.real is None else "--validation"
    words = ["learnt.parquet", role, "judge.parquet", "--estimator", given.estimator]
    run_measure(_CHECKOUT, given.folder, "train", *words, "--out", "model.onnx", "--overwrite")
    card = (given.folder / "model.card.md").read_text("utf-8")
    print("\n".join(line for line in card.splitlines() if "otation of the tip" in line))


if __name__ == "__main__":
    run_command(main)

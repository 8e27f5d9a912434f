"""From pictures to a correction by commands alone: `python -m benchmarks.closed_loop FOLDER`.

What docs/how_to/correct_a_robot.md says, typed: render a recording of the simulated robot, measure
it, pair it with the robot's log, train, and correct a second recording, after another restart, as
it is and re-zeroed on its own first part, which is measured, too. FOLDER keeps what is done.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import rms
from measure_learning.robots import raven_schema, read_log
from measure_learning.robots.tables import Table


def main() -> None:
    """Run what has not been run, and print the errors."""
    parser = argparse.ArgumentParser(prog="benchmarks.closed_loop", description=__doc__)
    parser.add_argument("folder", type=Path, help="keeps recordings, runs, data and models")
    parser.add_argument("--seconds", type=float, default=420.0, help="of the first recording")
    parser.add_argument("--second", type=float, default=60.0, help="seconds of the second one")
    parser.add_argument("--frame-hz", type=float, default=15.0, help="frame sets per second")
    parser.add_argument("--cut-s", type=float, default=60.0, help="length of a trajectory")
    parser.add_argument("--pairing", default="", help="options of `measure dataset`")
    parser.add_argument("--options", default="", help="options of `measure train`")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for made, words in commands(given):
        if not (given.folder / made).exists():
            print(f"measure {words}", flush=True)
            command = [sys.executable, "-m", "measure", *shlex.split(words)]
            subprocess.run(command, cwd=given.folder, check=True)
    for line in errors(given.folder):
        print(line)


def commands(given: argparse.Namespace) -> list[tuple[str, str]]:
    """What each command makes, and its words."""
    hz = f"--frame-hz {given.frame_hz:g}"
    pair = f"--robot-log {{0}}/robot.parquet --out {{0}}.parquet {given.pairing}"
    estimate = "estimate model.onnx --input second/robot.parquet --out"
    return [
        ("first/session.toml", f"simulate first --seconds {given.seconds:g} {hz} --seed 1"),
        ("second/session.toml", f"simulate second --seconds {given.second:g} {hz} --seed 2"),
        ("first-run/poses.csv", "run first --out first-run --no-recording"),
        ("second-run/poses.csv", "run second --out second-run --no-recording"),
        ("first.parquet", f"dataset first-run {pair.format('first')} --cut-s {given.cut_s:g}"),
        ("second.parquet", f"dataset second-run {pair.format('second')}"),
        ("model.onnx", f"train first.parquet --out model.onnx {given.options}"),
        ("corrected.parquet", f"{estimate} corrected.parquet"),
        ("rezeroed.parquet", f"{estimate} rezeroed.parquet --rezero second.parquet"),
    ]


def errors(folder: Path) -> list[str]:
    """RMS errors of the second recording's positions against its truth."""
    log = read_log(folder / "second" / "robot.parquet", raven_schema())
    table = np.loadtxt(folder / "second" / "truth.csv", delimiter=",", skiprows=1)
    reported = log.schema.position_mm(log.states)
    wrong = table[:, 1:4] - reported
    lines = [f"reported   {rms(wrong):.3f} mm RMS"]
    for name in ("corrected", "rezeroed"):
        left = wrong - Table.read(folder / f"{name}.parquet").numbers("ex", "ey", "ez")
        lines.append(f"{name:10s} {rms(left):.3f} mm RMS, {rms(left) / rms(wrong) - 1:+.1%}")
    return lines


if __name__ == "__main__":
    run_command(main)

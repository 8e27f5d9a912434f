"""Formats of poses alone: CSV with covariances, and TUM as `evo` reads it."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from measure.errors import RunError
from measure.results.columns import matrices, numbers
from measure.results.pose_table import Velocities
from measure.results.run import Run
from measure.results.tables import PLACE, QUALITY

_WORDS = ("cameras", "balls", "flags")
_UPPER = np.triu_indices(6)
_AXES = (*PLACE[:3], "rx_rad", "ry_rad", "rz_rad")
VELOCITY = ("vx_mm_s", "vy_mm_s", "vz_mm_s", "wx_rad_s", "wy_rad_s", "wz_rad_s")
"""Of the origin and of the rotation, along the world's axes."""


def write_csv(
    runs: Sequence[Run], path: Path, velocities: Sequence[Velocities | None] = ()
) -> None:
    """Write a row a frame set: `frame, time_s`, the pose, its quality, 21 entries of covariance.

    And, if they are given, velocities and as many entries of theirs. A run of several bodies has a
    column `body`, and a row for each.
    """
    pairs = [f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)]
    if velocities:
        pairs += VELOCITY
        pairs += [f"cov_{VELOCITY[i]}_{VELOCITY[j]}" for i, j in zip(*_UPPER, strict=True)]
    named = ["body"] if len(runs) > 1 else []
    names = ["frame", *named, "time_s", *PLACE, *QUALITY, *_WORDS, "status", "reason", *pairs]
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(names)
        bodies = [
            _rows(run, [run.body.name] if named else [], moving)
            for run, moving in zip(runs, velocities or [None] * len(runs), strict=True)
        ]
        for rows in zip(*bodies, strict=True):
            out.writerows(rows)


def _rows(run: Run, named: list[str], moving: Velocities | None) -> Iterator[list[object]]:
    table = run.poses
    values = numbers(table, *PLACE, *QUALITY)
    covariances = matrices(table, "covariance", 6)[:, _UPPER[0], _UPPER[1]]
    if moving is not None:
        spread = moving.covariances[:, _UPPER[0], _UPPER[1]]
        covariances = np.concatenate([covariances, moving.values, spread], axis=1)
    words = {name: table[name].to_pylist() for name in (*_WORDS, "status", "reason")}
    for row, index in enumerate(table["index"].to_pylist()):
        yield [
            index,
            *named,
            f"{run.times_s[row]:.9f}",
            *map(_cell, values[row]),
            *(" ".join(words[name][row] or ()) for name in _WORDS),
            words["status"][row],
            words["reason"][row],
            *map(_cell, covariances[row]),
        ]


def write_tum(runs: Sequence[Run], path: Path) -> None:
    """Write a line for every pose, in metres; the format cannot say that one is missing.

    Raises:
        RunError: there are several bodies, for whose names the format has no place.
    """
    if len(runs) > 1:
        names = ", ".join(run.body.name for run in runs)
        raise RunError(f"a TUM file holds one body: choose one with --body ({names})")
    (run,) = runs
    poses = run.world_from_body
    quat = poses.quat_wxyz
    rows = np.column_stack(
        [run.times_s[run.has_pose], poses.translation / 1000, quat[:, 1:], quat[:, :1]]
    )
    lines = ["# time_s x_m y_m z_m qx qy qz qw (world_from_body)"]
    lines += [f"{row[0]:.9f} " + " ".join(f"{v:.12f}" for v in row[1:]) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _cell(value: float) -> str:
    return f"{value:.12g}" if np.isfinite(value) else ""

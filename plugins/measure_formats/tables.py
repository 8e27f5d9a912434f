"""Poses as CSV and TUM; balls and the body's origin as TRC and C3D.

TUM is what `evo` reads. TRC (Track Row Column) is the format of OpenSim, in millimetres and real
times; C3D the binary one of motion laboratories, written by ezc3d.
"""

from __future__ import annotations

import csv
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import RunError
from measure.results.pose_table import Velocities
from measure.results.run import Run
from measure.results.tables import (
    PLACE,
    QUALITY,
    codes,
    doubts_of,
    integers,
    matrices,
    numbers,
    texts,
)

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
    words = (*_WORDS, "status", "reason", "codes")
    names = ["frame", *named, "time_s", *PLACE, *QUALITY, *words, *pairs]
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
    doubts = doubts_of(table)
    for row, index in enumerate(table["index"].to_pylist()):
        yield [
            index,
            *named,
            f"{run.times_s[row]:.9f}",
            *map(_cell, values[row]),
            *(" ".join(words[name][row] or ()) for name in _WORDS),
            words["status"][row],
            words["reason"][row],
            " ".join(codes(doubts[row])),
            *map(_cell, covariances[row]),
        ]


def write_tum(runs: Sequence[Run], path: Path) -> None:
    """Write a line for every pose, in metres; RunError: several bodies have no place in it."""
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


ORIGIN = "body_origin"
_HEADINGS = (
    *("DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"),
    *("OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"),
)
CHANNELS = ("time_s", "frame")
MOST_C3D_FRAMES = 65_534
"""C3D counts frames in 16 bits. Parameters may hold larger counts (TRIAL:ACTUAL_END_FIELD,
POINT:LONG_FRAMES), but ezc3d passes over them: it reads the first 65,535 and says nothing; py-c3d
goes by them, and without them reads none of 65,535."""


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers over time."""

    names: tuple[str, ...]  # of the k markers: the balls, then the body's origin
    times_s: Floats  # (n,) of the frame sets
    points_mm: Floats  # (n, k, 3) in the world, NaN where one was not located
    rate_hz: float  # frame sets a second, by the median step


def markers_of(runs: Sequence[Run]) -> Markers:
    """The markers of a run: balls as triangulated, origins from the poses.

    Those of several bodies have their body's name before their own.
    """
    every = [_markers_of(run) for run in runs]
    if len(every) == 1:
        return every[0]
    names = [f"{r.body.name}.{name}" for r, m in zip(runs, every, strict=True) for name in m.names]
    points_mm = np.concatenate([one.points_mm for one in every], axis=1)
    return replace(every[0], names=tuple(names), points_mm=points_mm)


def _markers_of(run: Run) -> Markers:
    names = (*run.body.names, ORIGIN)
    points = np.full((len(run.times_s), len(names), 3), np.nan)
    table = run.balls
    rows = integers(table, "index")
    columns = np.array([names.index(ball) for ball in texts(table, "ball")], dtype=np.int64)
    points[rows, columns] = numbers(table, "x_mm", "y_mm", "z_mm")
    points[run.has_pose, -1] = run.world_from_body.translation
    steps = np.diff(run.times_s)
    rate = 1 / float(np.median(steps)) if len(steps) else 1.0
    return Markers(names, run.times_s, points, rate)


def write_trc(runs: Sequence[Run], path: Path) -> None:
    """Write every frame set; a marker that was not located is left empty."""
    markers = markers_of(runs)
    count, rate = len(markers.times_s), f"{markers.rate_hz:.6f}"
    coordinates = [f"{axis}{k}" for k in range(1, len(markers.names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "\t".join(_HEADINGS),
        f"{rate}\t{rate}\t{count}\t{len(markers.names)}\tmm\t{rate}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(markers.names) + "\t\t",
        "\t\t" + "\t".join(coordinates),
        "",
    ]
    for k in range(count):
        places = markers.points_mm[k].reshape(-1)
        cells = "\t".join(f"{v:.6f}" if np.isfinite(v) else "" for v in places)
        lines.append(f"{k + 1}\t{markers.times_s[k]:.9f}\t{cells}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_c3d(runs: Sequence[Run], path: Path) -> None:
    """Write every frame set; a marker that was not located is invalid there.

    C3D knows a rate, but no times: those since the first frame set stand in the analog channel
    `time_s`, the frame set's number in `frame`.
    """
    import ezc3d

    markers = markers_of(runs)
    count = len(markers.times_s)
    if count > MOST_C3D_FRAMES:
        raise RunError(
            f"{path}: {count} frame sets, and programs read {MOST_C3D_FRAMES} of a C3D file at "
            "most: export csv, tum, trc or mcap, which hold any number"
        )
    file = ezc3d.c3d()
    points = file["parameters"]["POINT"]
    points["RATE"]["value"] = [markers.rate_hz]
    points["LABELS"]["value"] = list(markers.names)
    points["UNITS"]["value"] = ["mm"]
    homogeneous = np.ones((4, len(markers.names), count))
    homogeneous[:3] = markers.points_mm.transpose(2, 1, 0)
    file["data"]["points"] = homogeneous
    analog = file["parameters"]["ANALOG"]
    analog["RATE"]["value"] = [markers.rate_hz]
    analog["LABELS"]["value"] = list(CHANNELS)
    analog["UNITS"]["value"] = ["s", ""]
    channels = np.stack([markers.times_s - markers.times_s[0], np.arange(count)])
    file["data"]["analogs"] = channels[None]
    # ezc3d says nothing of a file that it could not write, and knows UTF-8 names only: it writes
    # where it can, and what it wrote is copied.
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch) / "run.c3d"
        file.write(str(whole))
        least = 4 * (homogeneous.size + channels.size)
        if not whole.exists() or whole.stat().st_size < least:
            raise OSError(f"{scratch} did not take its {least} bytes: is the disk full?")
        shutil.copyfile(whole, path)

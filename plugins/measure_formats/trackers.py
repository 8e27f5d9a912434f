"""Rigid bodies in the files of commercial trackers: Motive, Vicon, Qualisys and NDI.

Each writes headings of its own, several bodies side by side, and numbers in its own units:

- Motive (OptiTrack), CSV: names, properties and axes of the columns in rows of their own;
  quaternions x y z w, or angles in deg about the body's own axes in the order of "Rotation Type".
- Vicon Nexus and Tracker, CSV: RX RY RZ are a rotation vector ("helical"), with RW a quaternion
  x y z w.
- Qualisys Track Manager, 6D TSV: Rot[0] to Rot[8] hold the rotation matrix column by column.
- NDI ToolBox and sample programs of its API, CSV: quaternions w x y z, mm, 60 frames a second.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.errors import MeasureError
from measure.session import Format, TrackedBody
from measure.tables import csv_rows

_LENGTHS_MM = {
    "mm": 1.0,
    "millimeters": 1.0,
    "cm": 10.0,
    "centimeters": 10.0,
    "m": 1000.0,
    "meters": 1000.0,
    "in": 25.4,
    "inches": 25.4,
}
_NDI_RATE_HZ = 60.0
_NDI_CELLS = ["q0", "qx", "qy", "qz", "tx", "ty", "tz"]
_NDI_LOST = ("missing", "disabled", "invalid", "unoccupied")


def tracker_bodies(
    path: Path, text: str, error: type[MeasureError]
) -> dict[str, TrackedBody] | None:
    """The rigid bodies of a tracker's file by name, or `error`; None if it is no such file."""
    first = next((line for line in text.splitlines() if line.strip()), "")
    separator = "\t" if "\t" in first else ","
    cells = [cell.strip().lower() for cell in first.split(separator)]
    kinds = {"format version": _motive, "no_of_frames": _qualisys}
    kinds |= dict.fromkeys(("objects", "segments", "trajectories", "model outputs"), _vicon)
    read = _ndi if set(_NDI_CELLS) <= set(cells) else kinds.get(cells[0])
    if read is None:
        return None
    numbered = csv_rows(text, separator, error, str(path))
    rows = [[cell.strip() for cell in row] for _, row in numbered]
    try:
        found = read(rows)
    except (KeyError, IndexError, ValueError, ZeroDivisionError) as problem:
        raise error(
            f"{path}: its headings are not those of a tracker's export: {problem}"
        ) from None
    if not found:
        raise error(f"{path}: holds no rigid body: export rigid bodies (6 degrees of freedom)")
    return found


def _motive(rows: list[list[str]]) -> dict[str, TrackedBody]:
    given = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    head = _row_of_frames(rows)
    kinds = next((row for row in rows[1:head] if "Rigid Body" in row), [])
    names = rows[rows.index(kinds) + 1] if kinds else []
    places: dict[str, dict[str, int]] = {}
    for column, kind in enumerate(kinds):
        if kind == "Rigid Body":
            property_of = f"{rows[head - 1][column]} {rows[head][column]}"
            places.setdefault(names[column], {})[property_of] = column
    order = given.get("Rotation Type", "Quaternion")
    out = {}
    for name, at in places.items():
        turns = [at[f"Rotation {axis}"] for axis in ("WXYZ" if "Rotation W" in at else order)]
        where = [at[f"Position {axis}"] for axis in "XYZ"]
        to_quat = (
            np.asarray
            if len(turns) == 4
            else partial(_of_turn, partial(Rotation.from_euler, order, degrees=True))
        )
        unit = _unit_mm(given.get("Length Units", "Meters"))
        out[name] = TrackedBody(rows, head, [1], [1.0], turns, to_quat, where, unit)
    return out


def _vicon(rows: list[list[str]]) -> dict[str, TrackedBody]:
    head, rate = _row_of_frames(rows), float(rows[1][0])
    headings, units, names = rows[head], rows[head + 1], rows[head - 1]
    out = {}
    for k, name in enumerate(names):
        if not name or headings[k : k + 3] != ["RX", "RY", "RZ"]:
            continue
        quaternion = headings[k + 3] == "RW"
        turns = [k + 3, k, k + 1, k + 2] if quaternion else [k, k + 1, k + 2]
        start = headings.index("TX", k)
        in_deg = units[k].startswith("deg")
        to_quat = (
            np.asarray
            if quaternion
            else partial(_of_turn, partial(Rotation.from_rotvec, degrees=in_deg))
        )
        body = TrackedBody(
            rows,
            head + 1,
            times=[0],
            units_s=[1 / rate],
            turns=turns,
            quat_wxyz=to_quat,
            places=[start, start + 1, start + 2],
            unit_mm=_unit_mm(units[start]),
            begin_s=1 / rate,  # frames count from 1
        )
        out[name.removeprefix("Global Angle ")] = body
    return out


def _qualisys(rows: list[list[str]]) -> dict[str, TrackedBody]:
    head = _row_of_frames(rows)
    names = next((row[1:] for row in rows[:head] if row and row[0] == "BODY_NAMES"), [])
    starts = [k for k, heading in enumerate(rows[head]) if heading == "X"]
    out = {}
    for name, k in zip(names, starts, strict=False):
        matrix = rows[head].index("Rot[0]", k)
        turns = list(range(matrix, matrix + 9))
        out[name] = TrackedBody(rows, head, [1], [1.0], turns, _of_columns, [k, k + 1, k + 2])
    return out


def _ndi(rows: list[list[str]]) -> dict[str, TrackedBody]:
    lower = [cell.lower().strip("#") for cell in rows[0]]
    out: dict[str, TrackedBody] = {}
    before = 0
    for k in range(len(lower)):
        if lower[k : k + 7] != _NDI_CELLS:
            continue
        own = {lower[i]: i for i in range(before, k)}
        state = own.get("state", own.get("transformstatus"))
        seen = [[] if _is_lost(row, state) else row for row in rows]
        name = next((rows[0][i] for n, i in own.items() if n.startswith("port ")), "")
        times, units = [own["frame"]], [1 / _NDI_RATE_HZ]
        if "timespec_s" in own:
            times, units = [own["timespec_s"], own["timespec_ns"]], [1.0, 1e-9]
        turns, places = list(range(k, k + 4)), list(range(k + 4, k + 7))
        name = name or f"tool {len(out) + 1}"
        out[name] = TrackedBody(seen, 0, times, units, turns, np.asarray, places)
        before = k + 7
    return out


def _is_lost(row: list[str], state: int | None) -> bool:
    return state is not None and (
        state >= len(row) or any(word in row[state].lower() for word in _NDI_LOST)
    )


def _row_of_frames(rows: list[list[str]]) -> int:
    """The row of headings: it begins with the frame."""
    return next(k for k, row in [*enumerate(rows), (-1, ["Frame"])] if row[:1] == ["Frame"])


def _unit_mm(name: str) -> float:
    if name.lower() not in _LENGTHS_MM:
        raise ValueError(f"lengths in '{name}', expected {', '.join(_LENGTHS_MM)}")
    return _LENGTHS_MM[name.lower()]


def _of_turn(turn: Callable[[Floats], Rotation], values: Floats) -> Floats:
    return turn(values).as_quat(scalar_first=True)


def _of_columns(values: Floats) -> Floats:
    rotations = np.swapaxes(values.reshape(-1, 3, 3), 1, 2).copy()
    off = np.abs(rotations @ np.swapaxes(rotations, 1, 2) - np.eye(3)).max(axis=(1, 2), initial=0)
    good = (off < 1e-3) & (np.linalg.det(rotations) > 0)
    rotations[~good] = np.eye(3)
    quaternions = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    quaternions[~good] = np.nan
    quaternions[~values.any(axis=1)] = 0  # Of a body that is lost
    return quaternions


TRACKERS = Format(
    "trackers", "rigid bodies of Motive, Vicon, Qualisys and NDI", read_truth=tracker_bodies
)

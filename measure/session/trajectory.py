"""Poses over time, read from files and interpolated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

from measure.arrays import Bools, Floats
from measure.bags import is_bag, split_topic
from measure.errors import MeasureError, SessionError
from measure.geometry import RigidTransform
from measure.limits import CLEAR_RATIO
from measure.neighbours import lacking
from measure.reading import listed, read_text
from measure.session.formats import able
from measure.session.lost_body import lost_rows
from measure.session.tracked_body import TrackedBody
from measure.tables import STEPS_S, UNITS_S, Dialect, read_number_table

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

COLUMNS = ("time_s", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
MAX_GAP_PERIODS = 5.0
"""Between samples farther apart than this many median periods nothing is interpolated."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses at increasing times."""

    times_s: Floats  # (n,)
    world_from_body: RigidTransform  # a batch of n
    source: str = "trajectory"
    notes: tuple[str, ...] = ()  # what to know of how it was read

    def __len__(self) -> int:
        return len(self.times_s)

    def covers(self, times_s: ArrayLike) -> Bools:
        """At which times (m,) there is a pose: between samples, and in no gap."""
        wanted = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        before = np.searchsorted(self.times_s, wanted, side="right") - 1
        inside = (before >= 0) & (wanted <= self.times_s[-1])
        across = np.append(self._gaps, False)[before]
        return inside & (np.isin(wanted, self.times_s) | ~across)

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """The poses at times (m,), as a batch of m; or the one pose at a time.

        Positions run along a cubic through the samples (slopes by second-order differences),
        rotations along the great arc between two. SessionError: a time lies outside the samples or
        in a gap.
        """
        wanted = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        if not np.all(self.covers(wanted)):
            first = wanted[~self.covers(wanted)][0]
            raise SessionError(
                f"{self.source} has no pose at {first:.6f} s: it runs from {self.times_s[0]:.6f} "
                f"to {self.times_s[-1]:.6f} s" + (", with gaps" if np.any(self._gaps) else "")
            )
        poses = self._interpolated(wanted)
        return poses if np.ndim(times_s) else poses[0]

    @cached_property
    def _gaps(self) -> Bools:
        """Which steps (n - 1,) are too long to interpolate."""
        steps = np.diff(self.times_s)
        return steps > MAX_GAP_PERIODS * np.median(steps) if len(steps) else np.zeros(0, bool)

    def _interpolated(self, times_s: Floats) -> RigidTransform:
        known = self.world_from_body
        if len(self) == 1:
            only = np.zeros(len(times_s), dtype=np.int64)
            return RigidTransform(known.rotation[only], known.translation[only])
        turn, place = self._interpolants
        return RigidTransform(turn(times_s).as_matrix(), place(times_s))

    @cached_property
    def _interpolants(self) -> tuple[Slerp, CubicHermiteSpline]:
        from scipy.interpolate import CubicHermiteSpline  # slow to load, and few know the truth

        known = self.world_from_body
        turn = Slerp(self.times_s, Rotation.from_matrix(known.rotation))
        return turn, CubicHermiteSpline(self.times_s, known.translation, self._slopes)

    @cached_property
    def _slopes(self) -> Floats:
        out = np.zeros_like(self.world_from_body.translation)
        for part in np.split(np.arange(len(self)), np.flatnonzero(self._gaps) + 1):
            if len(part) > 1:
                position = self.world_from_body.translation[part]
                edge: Literal[1, 2] = 2 if len(part) > 2 else 1
                out[part] = np.gradient(position, self.times_s[part], axis=0, edge_order=edge)
        return out


def read_trajectory(
    path: Path | str,
    error: type[MeasureError] = SessionError,
    body: str | None = None,
    during_s: tuple[float, float] | None = None,
) -> Trajectory:
    """Read poses over time; `body` chooses one of several.

    Our CSV (`time_s,x_mm,y_mm,z_mm,qw,qx,qy,qz`: truth.csv, poses.csv; rows without a pose are
    passed over; with a column `body` it holds several bodies), TUM (`time_s x y z qx qy qz qw`,
    metres), or another program's file (`Format.read_truth`), found by content. Rows in which a
    tracker had lost the body are left out, and noted.

    Args:
        path: the file, or `bag#topic`.
        during_s: begin and end of what it is compared with: tells times in ms, us or ns, which is
            noted.

    Raises:
        error: the file cannot be used; with file and line where a value is wrong or the time does
            not increase.
    """
    path = Path(path)
    in_bag = is_bag(split_topic(path)[0])
    text = "" if in_bag else read_text(path, error)
    bodies = _tracked(path, text, error)
    first = next((line for line in text.splitlines() if line.strip()), "")
    several = "body" in Dialect.of(text).names
    if bodies is not None:
        values, lines = bodies[_one_of(path, bodies, body, error)].read(path, error)
    elif in_bag:
        raise lacking("bags of ROS", "measure_formats")
    elif body is not None and not several:
        raise error(f"{path}: holds one body without a name, and no '{body}'")
    elif first.startswith("#") or ("," not in first and len(first.split()) == 8):
        values, lines = _read_tum(path, error)
    else:
        words = ("body",) if several else ()
        table = read_number_table(path, COLUMNS, "", error, empty_is_nan=True, words=words)
        values, lines = np.stack([table.columns[name] for name in COLUMNS], axis=1), table.lines
        if several:
            mine = np.array(table.words["body"]) == _one_of(
                path, dict.fromkeys(table.words["body"]), body, error
            )
            values, lines = values[mine], [lines[i] for i in np.flatnonzero(mine)]
    here = np.flatnonzero(~np.isnan(values[:, 1:4]).all(axis=1))
    return _checked(path, values[here], [lines[i] for i in here], during_s, error)


def _tracked(path: Path, text: str, error: type[MeasureError]) -> Mapping[str, TrackedBody] | None:
    """The rigid bodies in a file of another program; None if it is of none."""
    found = (read(path, text, error) for read in able("read_truth").values())
    return next((bodies for bodies in found if bodies is not None), None)


def _one_of(
    path: Path, bodies: Mapping[str, object], name: str | None, error: type[MeasureError]
) -> str:
    """The name of the body called `name`, or of the only one."""
    if name is None and len(bodies) == 1:
        return next(iter(bodies))
    if name is not None and name in bodies:
        return name
    asked = f"none of them is called '{name}'" if name else "name one with --truth-body"
    raise error(f"{path}: holds the rigid bodies {', '.join(bodies)}: {asked}")


def _read_tum(path: Path, error: type[MeasureError]) -> tuple[Floats, list[int]]:
    rows, lines = [], []
    for number, line in enumerate(read_text(path, error).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            row = [float(cell) for cell in line.split()]
        except ValueError:
            raise error(f"{path}:{number}: not eight numbers: {line[:60]!r}") from None
        if len(row) != 8:
            raise error(f"{path}:{number}: a TUM line has eight numbers, this one {len(row)}")
        rows.append([row[0], *(1000 * v for v in row[1:4]), row[7], *row[4:7]])
        lines.append(number)
    return np.array(rows, dtype=np.float64).reshape(-1, 8), lines


def _checked(
    path: Path,
    values: Floats,
    lines: list[int],
    during_s: tuple[float, float] | None,
    error: type[MeasureError],
) -> Trajectory:
    """The poses in rows (n, 8), without those that are none; refused by `error`."""
    if not len(values):
        raise error(f"{path}: holds no pose")
    for i in np.flatnonzero(np.isnan(values[:, 4:]).all(axis=1)):
        raise error(f"{path}:{lines[i]}: not a rotation")
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1)):
        raise error(f"{path}:{lines[i]}: a value is missing or not finite")
    for i in np.flatnonzero(np.diff(values[:, 0]) <= 0):
        raise error(
            f"{path}:{lines[i + 1]}: time does not increase, from {values[i, 0]:.6f} s to "
            f"{values[i + 1, 0]:.6f} s"
        )
    unit, notes = "s", list[str]()
    if during_s is not None:
        unit = _unit_of_times(path, values[:, 0], during_s, error)
    if unit != "s":
        notes.append(
            f"{path}: its times are {np.mean(np.diff(values[:, 0])):.4g} apart: they are taken "
            f"for {unit}"
        )
        values = np.column_stack([values[:, 0] * UNITS_S[unit], values[:, 1:]])
    lost = lost_rows(values)
    gone = np.any(list(lost.values()), axis=0) if lost else np.zeros(len(values), bool)
    if gone.all():
        raise error(f"{path}: holds no pose: all rows hold {' or '.join(lost)}")
    if lost:
        notes.append(_of_lost(path, values[:, 0], lost, gone))
    values, lines = values[~gone], [lines[i] for i in np.flatnonzero(~gone)]
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    for i in np.flatnonzero(np.abs(lengths - 1) > 1e-2):
        raise error(
            f"{path}:{lines[i]}: not a rotation: the quaternion's length is {lengths[i]:.4g}, not 1"
        )
    poses = RigidTransform.from_quat_wxyz(values[:, 4:], values[:, 1:4])
    return Trajectory(values[:, 0], poses, str(path), tuple(notes))


def _unit_of_times(
    path: Path, times: Floats, during_s: tuple[float, float], error: type[MeasureError]
) -> str:
    """Which unit the times are in: that which gives the most time together, or else of one length.

    Seconds unless rows would be farther apart than of any tracker.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if step <= STEPS_S[1]:
        return "s"
    begin, end = during_s
    together, alike = dict[str, float](), dict[str, float]()
    for unit, unit_s in UNITS_S.items():
        if unit == "s" or STEPS_S[0] <= step * unit_s <= STEPS_S[1]:
            first, last = times[0] * unit_s, times[-1] * unit_s
            both = max(min(last, end) - max(first, begin), 0.0)
            together[unit] = both / (max(last, end) - min(first, begin))
            lengths = sorted((last - first, end - begin))
            alike[unit] = lengths[0] / lengths[1]
    scores = together if any(together.values()) else alike
    best, *others = sorted(scores, key=lambda unit: -scores[unit])
    if others and scores[best] < CLEAR_RATIO * scores[others[0]]:
        raise error(
            f"{path}: its times are {step:.4g} apart: in {best} or in {others[0]}? Write seconds"
        )
    return best


def _of_lost(path: Path, times_s: Floats, lost: Mapping[str, Bools], gone: Bools) -> str:
    """How many rows are left out, why, and when they were; in words."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], gone, [False]]).astype(int)))
    spans = [
        f"{times_s[a]:.3f} s" if a + 1 == b else f"{times_s[a]:.3f} to {times_s[b - 1]:.3f} s"
        for a, b in edges.reshape(-1, 2)
    ]
    holding = " and ".join(f"{rows.sum()} hold {what}" for what, rows in lost.items())
    return (
        f"{path}: {gone.sum()} of {len(gone)} rows ({100 * gone.mean():.0f} %) are left out, as "
        f"their tracker had lost the body: {holding} ({listed(spans)})"
    )

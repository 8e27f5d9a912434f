"""Rows that a tracker wrote while it had lost the body: they hold a number, and no pose.

Some trackers then write zeros, some numbers that nothing reaches, some the last pose again and
again. A body may as well rest, or pass through zero: its pose then goes on from there, where that
of a lost body jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.session.tracked_body import FARTHEST_MM

_ARM_MM = 80.0  # A step of a quaternion counts as what twice its angle moves at 40 mm
_NINES = ("999", "9999", "99999", "999999", "9999999")
_JUMP_RATIO = 5.0
"""Times as fast as nearly everything else: no body, once lost and found, moves so."""
_USUAL_SHARE, _FEWEST_STEPS = 0.99, 3
"""The share of steps that are slower than what counts as fastest, of at least so many."""
_CAUGHT_UP_RATIO = 1.5
"""What was held has to catch up a step at least; what rested begins with a shorter one."""
_SLOWING_RATIO = 0.6
"""The last step of a body that comes to rest is shorter by so much than the one before."""
_SHORTEST_STOP_S = 0.2
"""Between two jumps, what is held for a shorter time is a tracker's period, and no stop."""
_QUANTA = 2.0  # Steps of so many last digits are what rounding makes of a slow motion


def lost_rows(values: Floats) -> dict[str, Bools]:
    """Which rows (n, 8) of time, position in mm and quaternion hold no pose, by what they hold.

    The quaternions may be of length 0; times increase.
    """
    places, turns = values[:, 1:4], values[:, 4:]
    lost = {
        "no rotation (a quaternion of zeros)": np.all(turns == 0, axis=1),
        "positions that no body reaches": np.any(np.abs(places) >= FARTHEST_MM, axis=1),
    }
    zeros, nines = np.all(places == 0, axis=1), _are_nines(places)

    def left() -> Ints:
        return np.flatnonzero(~np.any(list(lost.values()), axis=0))

    far = _Holds.of(values, left(), zeros | nines).far()
    lost["zeros for the position"], lost["only nines for the position"] = far & zeros, far & nines
    nothing = np.zeros(len(values), bool)
    lost["one pose again and again, far from all others"] = _Holds.of(values, left(), nothing).far()
    held = _Holds.of(values, left(), nothing).held()
    lost["the pose before to its last digit, while the body moves"] = held
    return {what: rows for what, rows in lost.items() if rows.any()}


def _are_nines(places: Floats) -> Bools:
    """Which positions (n, 3) are, in mm or m, nothing but nines."""
    some = np.unique(np.abs(places[np.all(np.abs(places) == np.abs(places[:, :1]), axis=1), 0]))
    written = [v for v in some.tolist() if {f"{v:.0f}", f"{v / 1000:.0f}"} & {*_NINES}]
    return np.asarray(np.isin(np.abs(places), written).all(axis=1))


def _last_digit(column: Floats) -> float:
    """The unit of the last decimal digit that numbers (n,) were written with.

    0 if they have many, or do not change by one.
    """
    for power in 10.0 ** np.arange(9):
        scaled = column * power
        if len(scaled) and np.ptp(scaled) > 0.5 and np.all(np.abs(scaled - np.rint(scaled)) < 1e-4):
            return float(1 / power)
    return 0.0


@dataclass(frozen=True, eq=False)
class _Holds:
    """Rows that hold the same, one after the other, taken together."""

    rows: Ints  # of the table, which are looked at
    first: Ints  # (g,) positions among these at which each begins, and
    count: Ints  # (g,) how many rows it has
    marked: Bools  # (g,) which are of the marked rows
    begin_s: Floats  # (g,) time of the first row
    steps: Floats  # (g - 1,) to the next one, mm
    speeds: Floats  # (g - 1,) the same by time
    rounding: float  # the step of one last digit in everything, mm
    size: int  # of the table

    @classmethod
    def of(cls, values: Floats, rows: Ints, marked: Bools) -> _Holds:
        """Of some rows of a table; those `marked` (n,) that follow each other belong together."""
        poses = values[rows, 1:] * np.array([1.0] * 3 + [_ARM_MM] * 4)
        flips = np.sum(poses[1:, 3:] * poses[:-1, 3:], axis=1) < 0  # q and -q are one rotation
        poses[1:, 3:] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
        moved = np.diff(poses, axis=0)
        same = np.all(moved == 0, axis=1) | (marked[rows][1:] & marked[rows][:-1])
        first = np.flatnonzero(np.concatenate([[True], ~same])[: len(rows)])
        count = np.diff(np.append(first, len(rows)))
        digits = [_last_digit(column) for column in values[rows, 1:].T]
        steps = np.linalg.norm(poses[first[1:]] - poses[first[1:] - 1], axis=1)
        took_s = values[rows[first[1:]], 0] - values[rows[first[1:] - 1], 0]
        return cls(
            rows,
            first,
            count,
            marked[rows[first]],
            values[rows[first], 0],
            steps,
            steps / np.maximum(took_s, 1e-9),
            float(np.linalg.norm(digits * np.array([1.0] * 3 + [_ARM_MM] * 4))),
            len(values),
        )

    def far(self) -> Bools:
        """Which rows of the table are jumped to and from; of the marked ones, if there are any.

        Else of those that hold one pose, beside a body that moves.
        """
        holds = self.count > 1
        suspect = self.marked if self.marked.any() else holds
        usual = self.speeds[~(suspect | holds)[1:] & ~(suspect | holds)[:-1]]
        if len(usual) < _FEWEST_STEPS and self.marked.any():  # a body that rests
            usual = self.speeds[~suspect[1:] & ~suspect[:-1]]
        elif len(usual) < _FEWEST_STEPS:
            suspect = np.zeros_like(suspect)
        fastest = float(np.quantile(usual, _USUAL_SHARE)) if len(usual) else 0.0
        jumps = self.speeds > _JUMP_RATIO * fastest
        far = np.append(True, jumps) & np.append(jumps, True) & suspect
        return self._rows(far & bool(self.count[~suspect].sum() >= _FEWEST_STEPS))

    def held(self) -> Bools:
        """Which rows of the table repeat a pose of a body that moves; the first of each stays."""
        which = [k for k in np.flatnonzero(self.count > 1).tolist() if self._is_held(k)]
        out = self._rows(np.isin(np.arange(len(self.first)), which))
        out[self.rows[self.first]] = False
        return out

    def _is_held(self, k: int) -> bool:
        last = len(self.first) - 1
        if k == last:
            if k < 2 or self.count[k] < _FEWEST_STEPS or self.count[k - 1] > 1:
                return False
            is_move = bool(self.steps[k - 1] > _QUANTA * self.rounding)
            return is_move and bool(self.speeds[k - 1] > _SLOWING_RATIO * self.speeds[k - 2])
        if self.steps[k] <= _QUANTA * self.rounding:
            return False
        if k + 1 == last or self.count[k + 1] > 1:
            return bool(self.begin_s[k + 1] - self.begin_s[k] < _SHORTEST_STOP_S)
        return bool(self.speeds[k] > _CAUGHT_UP_RATIO * self.speeds[k + 1])

    def _rows(self, which: Bools) -> Bools:
        """The rows of the table that belong to some of the groups (g,)."""
        out = np.zeros(self.size, bool)
        out[self.rows] = np.repeat(which, self.count)
        return out

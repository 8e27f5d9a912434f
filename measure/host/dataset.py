"""Training data of estimators: states and measured position errors, by trajectory."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Bools, Floats, Ints, floats
from measure.errors import EstimatorError
from measure.robots import StateSchema

_BY_ROW = ("states", "times_s", "trajectory", "errors_mm", "covariances", "usable")


def recording_of(trajectory: str) -> str:
    """The recording, restart or day of a trajectory: its name up to the first "/"."""
    return trajectory.partition("/")[0]


@dataclass(frozen=True, eq=False)
class Turns:
    """Errors of a tip's rotation: exp(vector) times the reported rotation is the true one."""

    vectors_rad: Floats  # (..., 3) rotation vectors in the base frame; NaN where not measured
    covariances: Floats  # (..., 3, 3) in rad^2

    @classmethod
    def unknown(cls, count: int) -> Turns:
        """So many that are not measured."""
        return cls(np.full((count, 3), np.nan), np.tile(np.eye(3), (count, 1, 1)))

    @property
    def known(self) -> Bools:
        """Which are measured (...)."""
        return np.asarray(np.isfinite(self.vectors_rad).all(axis=-1))

    def __getitem__(self, rows: Bools | Ints | slice | int) -> Turns:
        return Turns(self.vectors_rad[rows], self.covariances[rows])

    def __setitem__(self, rows: Bools | Ints | slice | int, values: Turns) -> None:
        self.vectors_rad[rows], self.covariances[rows] = values.vectors_rad, values.covariances


@dataclass(frozen=True, eq=False)
class Dataset:
    """Rows of (state, position error), each trajectory's rows together and in time order.

    Rows without a usable label are kept: they belong to the history of the trajectory.
    """

    schema: StateSchema  # meaning of the columns of `states`
    states: Floats  # (n, features)
    times_s: Floats  # (n,) NaN where not recorded
    trajectory: Ints  # (n,) index into `names`
    names: tuple[str, ...]  # of the trajectories
    errors_mm: Floats  # (n, 3) measured minus reported position; NaN where not measured
    covariances: Floats  # (n, 3, 3) of the label, in mm^2
    usable: Bools  # (n,) whether the label is used for training and scoring
    turns: Turns | None = None  # (n,) errors of the rotation, if labels hold them

    def __post_init__(self) -> None:
        rows = len(self.trajectory)
        floats("states", self.states, rows, len(self.schema.features))
        floats("errors_mm", self.errors_mm, rows, 3)
        floats("covariances", self.covariances, rows, 3, 3)
        changes = np.flatnonzero(np.diff(self.trajectory)) + 1
        if len(changes) + 1 > len(np.unique(self.trajectory)) and rows:
            raise EstimatorError("a data set's rows must stand trajectory by trajectory: sort them")

    def __len__(self) -> int:
        return len(self.trajectory)

    @property
    def joints(self) -> Floats:
        """Joint positions (n, joints) in rad and mm."""
        return self.schema.joint_positions(self.states)

    @property
    def reported_mm(self) -> Floats:
        """Reported positions (n, 3)."""
        return self.schema.position_mm(self.states)

    def digest(self) -> str:
        """A short fingerprint: changes when a state, time, label, weight or trajectory does."""
        sha = hashlib.sha256(repr((self.schema.names, self.names)).encode())
        # States as files hold them.
        arrays = [self.states.astype(np.float32), *(getattr(self, n) for n in _BY_ROW[1:])]
        arrays += [] if self.turns is None else [self.turns.vectors_rad, self.turns.covariances]
        for array in arrays:
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()[:16]

    def runs(self) -> Iterator[tuple[str, slice]]:
        """Each trajectory's name and rows."""
        edges = np.flatnonzero(np.diff(self.trajectory, prepend=-1, append=-1))
        for start, stop in itertools.pairwise(edges):
            yield self.names[self.trajectory[start]], slice(int(start), int(stop))

    def present(self) -> tuple[str, ...]:
        """Names of the trajectories that have rows here."""
        return tuple(name for name, _ in self.runs())

    def recordings(self) -> dict[str, list[str]]:
        """Names of the trajectories that have rows here, by recording (see `recording_of`)."""
        found: dict[str, list[str]] = {}
        for name in self.present():
            found.setdefault(recording_of(name), []).append(name)
        return found

    def recording_groups(self, most: int, least: int) -> list[list[str]]:
        """Trajectories of recordings to leave out in turn, in groups of about as many labels.

        At most so many groups, of recordings with at least so many labels; the others are never
        left out. No groups where there are not two such recordings.
        """
        counts = {name: int(self.usable[rows].sum()) for name, rows in self.runs()}
        sizes = {r: sum(counts[n] for n in names) for r, names in self.recordings().items()}
        order = sorted((r for r in sizes if sizes[r] >= least), key=lambda r: -sizes[r])
        if min(most, len(order)) < 2:
            return []
        groups: list[list[str]] = [[] for _ in range(min(most, len(order)))]
        for recording in order:
            lightest = min(groups, key=lambda group: sum(sizes[r] for r in group))
            lightest.append(recording)
        return [[n for n in counts if recording_of(n) in group] for group in groups]

    def rows(self, keep: Bools) -> Dataset:
        """The data set of some rows only."""
        turns = self.turns and self.turns[keep]
        return replace(self, turns=turns, **{name: getattr(self, name)[keep] for name in _BY_ROW})

    def select(self, names: Sequence[str]) -> Dataset:
        """The data set of some trajectories only; EstimatorError: a name is unknown."""
        if unknown := sorted(set(names) - set(self.names)):
            raise EstimatorError(f"no trajectory {', '.join(unknown)}; there is {self.names}")
        wanted = [index for index, name in enumerate(self.names) if name in set(names)]
        return self.rows(np.isin(self.trajectory, wanted))

    def weights(self, floor_mm: float = 0.5) -> Floats:
        """Weights (n,) of the labels, mean one over usable rows, zero elsewhere.

        Args:
            floor_mm: SD per axis that even a perfect label would leave: it keeps a few precise
                labels from outvoting all others.
        """
        variance = np.trace(self.covariances, axis1=1, axis2=2) / 3.0 + floor_mm**2
        raw = np.where(self.usable, 1.0 / variance, 0.0)
        return raw / max(float(raw[self.usable].mean()), 1e-300) if self.usable.any() else raw

"""Two runs compared: of one session frame set by frame set, of two by their statistics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.metrology.poses import independent_count
from measure.results.pose_table import poses_of
from measure.results.provenance import flat
from measure.results.run import Run, read_run
from measure.results.tables import QUALITY, numbers, texts

_POSE = ("x_mm", "y_mm", "z_mm", "turn_x_deg", "turn_y_deg", "turn_z_deg")
_UNITS = np.array([1.0] * 3 + [180 / np.pi] * 3)
_STATES = ("ok", "flagged", "lost", "skipped")


@dataclass(frozen=True)
class Figure:
    """One figure of both runs; NaN where it is not known."""

    what: str
    first: float
    second: float
    difference: float  # second minus first
    sd: float  # of the difference, by the scatter of frame sets and how many are independent
    stated_sd: float = np.nan  # that the runs state of one such difference

    @property
    def sds(self) -> float:
        """The difference in its standard deviations."""
        return self.difference / self.sd if self.sd > 0 else np.nan


@dataclass(frozen=True)
class Comparison:
    """What differs between two runs."""

    same_session: bool
    paired: int  # frame sets with an unflagged pose in both; 0 of two sessions
    settings: dict[str, tuple[str, str]]  # that differ, by name
    states: dict[str, tuple[int, int]]  # how many frame sets ended how
    figures: tuple[Figure, ...]


def compare_runs(first: Run, second: Run) -> Comparison:
    """Compare two runs of one body; RunError: one of them holds no unflagged pose."""
    for run in (first, second):
        if not len(poses_of(run)):
            raise RunError(f"{run.path} holds no unflagged pose: there is nothing to compare")
    one, other = (run.provenance.get("session", {}).get("sha256") for run in (first, second))
    same = one is not None and one == other
    both = _both(first, second) if same else np.zeros(0, dtype=bool)
    figures = _paired(first, second, both) if both.any() else _unpaired(first, second)
    ends = [texts(run.poses, "status").tolist() for run in (first, second)]
    states = {state: (ends[0].count(state), ends[1].count(state)) for state in _STATES}
    return Comparison(
        same,
        int(both.sum()),
        _settings(first, second),
        {state: counts for state, counts in states.items() if any(counts)},
        (*figures, *_ball_figures(first, second)),
    )


def _settings(first: Run, second: Run) -> dict[str, tuple[str, str]]:
    """What `run.toml` holds otherwise in the two, but for the time and for where files lie."""
    settings = [flat(run.provenance, "") for run in (first, second)]
    return {
        key.strip("."): (str(settings[0].get(key, "unset")), str(settings[1].get(key, "unset")))
        for key in sorted({*settings[0], *settings[1]})
        if settings[0].get(key) != settings[1].get(key) and not key.endswith((".started", ".path"))
    }


def _both(first: Run, second: Run) -> Bools:
    """Which frame sets (n,), the first that both have, have an unflagged pose in both."""
    n = min(first.poses.num_rows, second.poses.num_rows)
    return np.asarray(first.unflagged[:n] & second.unflagged[:n])


def _paired(first: Run, second: Run, both: Bools) -> Iterator[Figure]:
    """Differences of poses and their quality, frame set by frame set."""
    rows = np.flatnonzero(both)
    places, spreads = [], []
    for run in (first, second):
        at = np.cumsum(run.has_pose)[rows] - 1
        poses = run.world_from_body
        places.append(RigidTransform(poses.rotation[at], poses.translation[at]))
        spreads.append(run.covariances[at])
    off = places[1].difference(places[0]) * _UNITS
    stated = np.sqrt(np.einsum("nii->ni", spreads[0] + spreads[1])) * _UNITS
    for k, what in enumerate(_POSE):
        where = places[0].translation[:, k] if k < 3 else np.zeros(len(rows))
        yield _figure(what, where, where + off[:, k], True, float(np.median(stated[:, k])))
    for what in QUALITY:
        values = [numbers(run.poses, what)[rows] for run in (first, second)]
        yield _figure(what, values[0], values[1], True)


def _unpaired(first: Run, second: Run) -> Iterator[Figure]:
    """Figures of quality over the unflagged poses of each."""
    shares = [run.unflagged.astype(np.float64) for run in (first, second)]
    yield _figure("share_ok", shares[0], shares[1], False)
    for what in QUALITY:
        values = [numbers(run.poses, what)[run.unflagged] for run in (first, second)]
        yield _figure(what, values[0], values[1], False)


def _figure(
    what: str, first: Floats, second: Floats, paired: bool, stated_sd: float = np.nan
) -> Figure:
    """Means, and the standard deviation of their difference."""
    parts = [second - first] if paired else [first, second]
    known = [part[np.isfinite(part)] for part in parts]
    if not all(len(part) > 1 for part in known):
        return Figure(what, np.nan, np.nan, np.nan, np.nan, stated_sd)
    off = [part - part.mean() for part in known]
    variance = sum(part.var(ddof=1) / independent_count(part[:, None]) for part in off)
    mean, other = float(np.nanmean(first)), float(np.nanmean(second))
    return Figure(what, mean, other, other - mean, float(np.sqrt(variance)), stated_sd)


def _ball_figures(first: Run, second: Run) -> Iterator[Figure]:
    """How far balls are apart by rays alone, where both bodies have them."""
    known = {one.balls: one for one in first.distances if one.count}
    for other in second.distances:
        one = known.get(other.balls)
        if one is not None and other.count:
            sd = float(np.hypot(one.uncertainty_mm, other.uncertainty_mm))
            what = f"{' - '.join(one.balls)}_mm"
            yield Figure(what, one.mean_mm, other.mean_mm, other.mean_mm - one.mean_mm, sd)


def compare(first: Path | str, second: Path | str, body: str | None = None) -> Comparison:
    """Compare two runs: their differences in standard deviations.

    Runs of one session are compared frame set by frame set, those of two by their statistics.
    `sds` is the difference in standard deviations that follow from its scatter: whether there is
    one. `stated_sd` is what the runs state of such a difference: whether it matters.

    Args:
        first: a run's folder.
        second: another's.
        body: which body, of runs of several.
    """
    return compare_runs(read_run(Path(first), body), read_run(Path(second), body))

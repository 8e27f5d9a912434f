"""The poses of a run that may be relied on; and the run with these smoothed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from measure.arrays import Floats, Ints
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.metrology.noise import Noise, SmoothMotion, noise_of, smooth_motion
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import SHORTEST_S, Rests, find_rests
from measure.results.run import Run
from measure.results.tables import PLACE, matrices, numbers

_log = logging.getLogger(__name__)

_FEWEST_STEPS = 3
"""Usual steps on either side of a pose, from which a velocity is taken if nothing is smoothed."""


@dataclass(frozen=True, eq=False)
class Velocities:
    """Velocities of all n frame sets, NaN where there is none."""

    values: Floats  # (n, 6) mm/s and rad/s, along the world's axes
    covariances: Floats  # (n, 6, 6)


def poses_of(run: Run) -> PoseTable:
    """The poses of a run that are not flagged."""
    return _table(run, np.flatnonzero(run.unflagged))


def rests_of(run: Run, shortest_s: float = SHORTEST_S) -> Rests:
    """Where the body of a run stands still, by its unflagged poses.

    Where most poses are flagged, as a wrong scale flags all, by all of them, with a warning.
    """
    poses = poses_of(run)
    if 2 * len(poses) < np.count_nonzero(run.has_pose):
        _log.warning("%s: most poses are flagged, and rests are of poses in doubt", run.path)
        poses = _table(run, np.flatnonzero(run.has_pose))
    return find_rests(poses, shared_errors(run), shortest_s)


def noise_at_rest(run: Run) -> Noise | None:
    """Noise of the unflagged poses about the means of their rests; None if the body never rests."""
    poses, deviations, groups = poses_of(run), [], []
    for n, rest in enumerate(find_rests(poses, shared_errors(run)).rests):
        here = (poses.times_s >= rest.start_s) & (poses.times_s <= rest.end_s)
        rows = np.flatnonzero(here)
        deviations.append(poses.take(rows).world_from_body.difference(rest.world_from_body))
        groups.append(np.column_stack([rows, np.full(len(rows), n)]))
    if not groups:
        return None
    rows, which = np.concatenate(groups).T
    at = poses.times_s[rows]
    return noise_of(at, np.concatenate(deviations), which, "the means of the rests")


def noise_about(run: Run, errors: Floats) -> Noise | None:
    """Noise of the unflagged poses about a truth, by the errors (n, 6) of all frame sets."""
    rows = np.flatnonzero(run.unflagged)
    rows = rows[np.isfinite(errors[rows]).all(axis=1)]
    return noise_of(run.times_s[rows], errors[rows], np.zeros(len(rows), np.int64), "the truth")


def shared_errors(run: Run) -> SharedErrors:
    """What the poses of a run err by together, by its calibration and body file."""
    return SharedErrors(run.cameras, run.body, run.scale_sd)


def smooth_run(run: Run, smooth_s: float | None) -> tuple[Run, Velocities]:
    """A run with its unflagged poses smoothed over `smooth_s` on either side, and velocities.

    With None poses stay as they are, and velocities are those of the nearest poses. ConfigError:
    `smooth_s` is not positive.
    """
    if smooth_s is not None and not 0 < smooth_s < np.inf:
        raise ConfigError(f"--smooth {smooth_s:g}: give the seconds on either side of a pose")
    rows = np.flatnonzero(run.unflagged)
    steps = np.diff(run.times_s)
    reach_s = _FEWEST_STEPS * float(np.median(steps)) if len(steps) else 1.0
    motion = smooth_motion(_table(run, rows), shared_errors(run), smooth_s or 1.01 * reach_s)
    n = run.poses.num_rows
    velocities = Velocities(np.full((n, 6), np.nan), np.full((n, 6, 6), np.nan))
    velocities.values[rows], velocities.covariances[rows] = motion.velocities, motion.covariances
    smoothed = run if smooth_s is None else replace(run, poses=_with(run.poses, rows, motion))
    return smoothed, velocities


def _table(run: Run, rows: Ints) -> PoseTable:
    place = numbers(run.poses, *PLACE)[rows]
    poses = RigidTransform.from_quat_wxyz(place[:, 3:], place[:, :3])
    return PoseTable(run.times_s[rows], poses, matrices(run.poses, "covariance", 6)[rows])


def _with(table: pa.Table, rows: Ints, motion: SmoothMotion) -> pa.Table:
    """The table of poses with those of some rows replaced."""
    poses, P = motion.poses.world_from_body, motion.poses.covariances
    variances = np.diagonal(P, axis1=1, axis2=2)
    new = dict(zip(PLACE, np.column_stack([poses.translation, poses.quat_wxyz]).T, strict=True))
    new["position_sd_mm"] = np.sqrt(variances[:, :3].sum(axis=1))
    new["rotation_sd_deg"] = np.degrees(np.sqrt(variances[:, 3:].sum(axis=1)))
    for name, values in new.items():
        column = numbers(table, name).copy()
        column[rows] = values
        table = table.set_column(table.column_names.index(name), table.field(name), [column])
    lists = table["covariance"].to_pylist()
    for row, covariance in zip(rows.tolist(), P, strict=True):
        lists[row] = covariance.ravel().tolist()
    field = table.field("covariance")
    at = table.column_names.index("covariance")
    return table.set_column(at, field, pa.array(lists, field.type))

"""Rests: stretches in which a body stands still, and the displacements between them.

A window of poses is still if they scatter no more than twice as much as the quietest do (standard
deviations, in units of the stated ones). The mean of a rest has what its poses scatter, divided by
how many of them are independent, and all of what they err by alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import DegenerateGeometryError
from measure.estimation.losses import TUKEY_SIGMAS, tukey_weights
from measure.geometry import RigidTransform, chi_square_quantile
from measure.metrology.poses import (
    PoseTable,
    SharedErrors,
    alike_part,
    independent_count,
    scatter_share,
    square_root,
)

SHORTEST_S = 0.5
_FEWEST = 5  # Poses: at least this many make a window
_STILL_RATIO = 4.0  # Variance of a window over that of the quietest, up to which it is still
_LEAST_SHARE = 0.05**2
"""Poses that scatter by less than a twentieth of what is stated count as that quiet."""
_MOST_SHARE = 2.0  # Poses that scatter by more than 1.4 times what is stated are moving
_QUIETEST = 0.05  # The quietest windows are this quantile of those that scatter less than that
_AT_ONCE = 100_000  # Poses that are compared at once
_PAUSE_STEPS = 10.0  # A rest ends where no pose comes for so many usual steps


@dataclass(frozen=True, eq=False)
class Rest:
    """A body at rest."""

    start_s: float  # time of its first pose
    end_s: float  # of its last
    poses: int  # how many were averaged
    independent: float  # how many independent ones they are worth
    world_from_body: RigidTransform  # their mean
    stated: Floats  # (6, 6) covariance that its poses state, their mean
    scatter: Floats  # (6, 6) covariance of a single pose about the mean, as they scatter
    noise: Floats  # (6, 6) covariance of the mean by that scatter
    light: Floats  # (6, 6) covariance by light, which all of its poses share


@dataclass(frozen=True, eq=False)
class Displacement:
    """From one rest to another."""

    shift_mm: Floats  # (3,) of the body's origin, in the world
    covariance: Floats  # (6, 6) of shift and turn
    distance_mm: float  # length of the shift
    distance_sd_mm: float  # its standard deviation
    turned_deg: float  # angle between the two
    turned_sd_deg: float  # standard deviation of the turn, 3-D


@dataclass(frozen=True, eq=False)
class Rests:
    """All rests of a recording."""

    rests: tuple[Rest, ...]  # in order of time
    covariance: Floats  # (6 n, 6 n) of their poses together
    noise_share: float  # scatter of the quietest poses over what is stated, variances; or NaN
    quietest: float  # the same of the quietest window, still or not; or NaN

    def __len__(self) -> int:
        return len(self.rests)

    def rest(self, number: int) -> Rest:
        """A rest by its number, which counts from 0; DegenerateGeometryError: there is none."""
        if not 0 <= number < len(self):
            raise DegenerateGeometryError(f"there is no rest {number}: {self.listed()}")
        return self.rests[number]

    def listed(self) -> str:
        """How many rests there are, in words."""
        if self.rests:
            last = len(self) - 1
            return f"there are {len(self)} rests, 0 to {last}" if last else "there is only rest 0"
        if np.isnan(self.quietest):
            return f"fewer than {_FEWEST} poses in a row can be relied on"
        return (
            "the body never stands still: where it is quietest its poses scatter "
            f"{np.sqrt(self.quietest):.1f} times as much as their standard deviation"
        )

    def block(self, a: int, b: int) -> Floats:
        """Covariance (6, 6) of the poses of two rests."""
        return self.covariance[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]

    def sds(self, number: int) -> tuple[float, float]:
        """Standard deviations of a rest's position (3-D, mm) and rotation (deg)."""
        P = np.diag(self.block(number, number))
        return float(np.sqrt(P[:3].sum())), float(np.degrees(np.sqrt(P[3:].sum())))

    def displacement(self, start: int, end: int) -> Displacement:
        """From one rest to another; what both err by alike cancels as far as it is alike."""
        a, b = self.rest(start).world_from_body, self.rest(end).world_from_body
        back = np.eye(6)  # of shift and turn by the first pose, negative
        back[3:, 3:] = b.rotation @ a.rotation.T
        across = back @ self.block(start, end)
        P = back @ self.block(start, start) @ back.T + self.block(end, end) - across - across.T
        shift, turn = b.translation - a.translation, (b @ a.inverse()).rotvec
        length = float(np.linalg.norm(shift))
        along = shift / length if length else np.zeros(3)
        return Displacement(
            shift,
            P,
            length,
            float(np.sqrt(along @ P[:3, :3] @ along)),
            float(np.degrees(np.linalg.norm(turn))),
            float(np.degrees(np.sqrt(np.trace(P[3:, 3:])))),
        )


def find_rests(poses: PoseTable, shared: SharedErrors, shortest_s: float = SHORTEST_S) -> Rests:
    """The stretches of at least `shortest_s` in which the body stands still."""
    windows = _windows(poses.times_s, shortest_s)
    if not windows:
        return Rests((), np.zeros((0, 0)), np.nan, np.nan)
    shares = _shares(poses, np.array(windows))
    quiet = shares[shares <= _MOST_SHARE]
    floor = max(float(np.quantile(quiet, _QUIETEST)), _LEAST_SHARE) if len(quiet) else np.nan
    limit = min(_STILL_RATIO * floor, _MOST_SHARE)
    still = [window for window, share in zip(windows, shares, strict=True) if share <= limit]
    found = [
        _averaged(poses.take(slice(*part)), shared)
        for stretch in _merged(still)
        for part in _split(poses, *stretch, limit)
    ]
    kept = tuple(rest for rest in found if rest.end_s - rest.start_s >= 0.8 * shortest_s)
    return Rests(kept, _joint_covariance(kept, shared), floor, float(shares.min()))


def _windows(times_s: Floats, shortest_s: float) -> list[tuple[int, int]]:
    """First and last-plus-one indices of overlapping windows without a pause."""
    if len(times_s) < _FEWEST:
        return []
    steps = np.diff(times_s)
    pauses = np.concatenate([[0], np.cumsum(steps > _PAUSE_STEPS * np.median(steps))])
    starts = np.arange(len(times_s) - _FEWEST + 1)
    ends = np.searchsorted(times_s, times_s[starts] + shortest_s, side="right")
    ends = np.minimum(np.maximum(ends, starts + _FEWEST), len(times_s))
    whole = pauses[ends - 1] == pauses[starts]
    whole &= times_s[ends - 1] - times_s[starts] >= 0.8 * shortest_s
    apart = max(int(np.median(ends - starts)) // 5, 1)
    return [(int(a), int(b)) for a, b in zip(starts[whole], ends[whole], strict=True)][::apart]


def _shares(poses: PoseTable, windows: Ints) -> Floats:
    """Scatter of stretches (k, 2) of poses about their means, over the stated variances."""
    out, sizes = np.zeros(len(windows)), np.diff(windows)[:, 0]
    for size in np.unique(sizes):
        which = np.flatnonzero(sizes == size)
        for few in np.array_split(which, 1 + len(which) * size // _AT_ONCE):
            starts = windows[few, :1]
            rows, at = starts + np.arange(size), poses.world_from_body
            start = RigidTransform(at.rotation[starts], at.translation[starts])
            deltas = RigidTransform(at.rotation[rows], at.translation[rows]).difference(start)
            deltas -= deltas.mean(axis=1, keepdims=True)
            out[few] = scatter_share(deltas, poses.covariances[rows].mean(axis=1))
    return out


def _merged(windows: list[tuple[int, int]]) -> list[tuple[int, int]]:
    out: list[tuple[int, int]] = []
    for start, end in windows:
        if out and start < out[-1][1]:
            out[-1] = out[-1][0], end
        else:
            out.append((start, end))
    return out


def _split(poses: PoseTable, start: int, end: int, limit: float) -> list[tuple[int, int]]:
    """A stretch, in parts where it scatters too much as a whole: it stepped or crept."""
    if end - start < _FEWEST:
        return []
    if _shares(poses, np.array([[start, end]]))[0] <= limit:
        return [(start, end)]
    x = poses.world_from_body[start:end].difference(poses.world_from_body[start])
    x = x / np.sqrt(np.diag(poses.covariances[start:end].mean(axis=0)))
    n, count = len(x), np.arange(1, len(x))[:, None]
    before = np.cumsum(x, axis=0)[:-1]
    apart = before / count - (x.sum(axis=0) - before) / (n - count)
    between = np.sum(apart**2, axis=1) * (count * (n - count))[:, 0]
    cut = start + 1 + int(np.argmax(between))
    return _split(poses, start, cut, limit) + _split(poses, cut, end, limit)


def _averaged(poses: PoseTable, shared: SharedErrors) -> Rest:
    """The robust mean of poses at rest; those that stand out have no weight."""
    centre = poses.world_from_body[len(poses) // 2]
    deltas = poses.world_from_body.difference(centre)
    stated = poses.covariances.mean(axis=0)
    inverse = np.linalg.pinv(stated, hermitian=True)
    mean, weights = np.median(deltas, axis=0), np.ones(len(deltas))
    for _ in range(10):
        off = deltas - mean
        squares = np.einsum("ni,ij,nj->n", off, inverse, off)
        scale = np.median(squares) / chi_square_quantile(0.5, 6)
        weights = tukey_weights(squares / max(scale, 1e-18), np.sqrt(6 * TUKEY_SIGMAS))
        mean = np.average(deltas, axis=0, weights=weights)
    used = weights > 0
    off = (deltas - mean)[used]
    in_sds = off / np.sqrt(np.diag(stated))
    independent = min(max(independent_count(in_sds), 2.0), len(off))
    scatter = off.T @ off / len(off) * independent / (independent - 1)
    pose = centre.perturb(mean)
    (factors,) = shared.factors(_table([pose], [stated]))
    share = float(scatter_share(off, stated, len(off) / independent))
    light = alike_part(share, stated, factors[:, :-1] @ factors[:, :-1].T)
    first, last = poses.times_s[used][[0, -1]].tolist()
    noise = scatter / independent
    return Rest(first, last, len(off), independent, pose, stated, scatter, noise, light)


def _joint_covariance(rests: tuple[Rest, ...], shared: SharedErrors) -> Floats:
    n = len(rests)
    if not n:
        return np.zeros((0, 0))
    poses = _table([rest.world_from_body for rest in rests], [rest.stated for rest in rests])
    factors = shared.factors(poses).reshape(6 * n, -1)
    roots = np.stack([square_root(rest.light) for rest in rests])
    light = np.einsum("ij,iab,jcb->iajc", shared.alike(poses.world_from_body), roots, roots)
    out = factors @ factors.T + light.reshape(6 * n, 6 * n)
    for k, rest in enumerate(rests):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += rest.noise
    return np.asarray(out)


def _table(poses: Sequence[RigidTransform], stated: Sequence[Floats]) -> PoseTable:
    places = RigidTransform.stack(poses)
    return PoseTable(np.arange(len(poses), dtype=np.float64), places, np.stack(stated))

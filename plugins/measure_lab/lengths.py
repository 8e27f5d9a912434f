"""Measured lengths against known ones; a tool's tip and axis.

Lengths, after VDI/VDE 2634 part 1 and ASTM E3064 in spirit: a rig passes while its length errors
lie within what it says of itself: the expanded uncertainty U of a single length is two standard
deviations (k = 2). Of many lengths some exceed U by chance, so that the rig is contradicted only
beyond the wider k at which all of them together hold as often.

The tip of a tool that is turned about a fixed point: with it at p in the body and at q in the
world, every pose has R p + t = q. Rotations are measured too, so the equations are linearised at
the adjusted poses (Gauss-Helmert model, see Mikhail and Ackermann 1976, Observations and Least
Squares, chapter 7); at the measured ones p would come out too short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from measure.arrays import Bools, Floats, rms_length
from measure.errors import DegenerateGeometryError
from measure.estimation.losses import tukey_weights
from measure.geometry import RigidTransform, chi_square_quantile, propagate, skew
from measure.limits import CLEAR_RATIO, FEWEST, MAX_STEPS
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import Rests

COVERAGE_FACTOR = 2.0
_COVERAGE = 2 * float(ndtr(COVERAGE_FACTOR)) - 1
_DEGREES = 50
"""Of freedom: a standard deviation is itself known to a tenth (GUM, JCGM 100:2008, G.4.2)."""


@dataclass(frozen=True, eq=False)
class MeasuredLengths:
    """n lengths as a rig measures them."""

    lengths_mm: Floats  # (n,)
    covariance: Floats  # (n, n) in mm^2
    middles_mm: Floats  # (n, 3) where, in the world
    single_sd_mm: Floats  # (n,) of a length from two single poses, by their scatter


@dataclass(frozen=True, eq=False)
class Acceptance:
    """Lengths judged."""

    names: tuple[str, ...]  # n of them
    known_mm: Floats  # (n,)
    length_errors_mm: Floats  # (n,) measured minus known
    expanded_mm: Floats  # (n,) expanded uncertainties of the errors, k = 2
    middles_mm: Floats  # (n, 3) where, in the world
    rms_mm: float
    max_mm: float  # largest absolute error
    repeatability_mm: float  # standard deviation with which a length comes again
    repeated: int  # how many lengths were repeated; 0: repeatability is by scatter at rest
    scale: float  # measured over known, less 1
    scale_expanded: float  # its expanded uncertainty, k = 2
    limit: float  # factor k beyond which one of so many lengths contradicts
    doubts: tuple[str, ...]  # what the rig already says against itself

    @property
    def ratios(self) -> Floats:
        """Errors (n,) over their expanded uncertainties."""
        return self.length_errors_mm / self.expanded_mm

    @property
    def beyond(self) -> Bools:
        """Whether each error (n,) is larger than any of so many lengths has by chance."""
        return np.asarray(np.abs(self.ratios) > self.limit / COVERAGE_FACTOR)

    @property
    def worst(self) -> int:
        """The length whose error is largest in its expanded uncertainty."""
        return int(np.argmax(np.abs(self.ratios)))

    @property
    def repeated_words(self) -> str:
        """What repeatability is here."""
        return "repeatability" if self.repeated else "single length's SD by scatter at rest"

    @property
    def sentence(self) -> str:
        """The test in a sentence."""
        return (
            f"{len(self.known_mm)} lengths are off by {self.rms_mm:.3f} mm RMS and "
            f"{self.max_mm:.3f} mm at most; {self.repeated_words} {self.repeatability_mm:.3f} mm; "
            f"scale {100 * self.scale:+.3f} % +- {100 * self.scale_expanded:.3f} % (k = 2)."
        )

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What cannot be by chance, a line each; empty if the rig is as good as it says."""
        wide = self.limit / COVERAGE_FACTOR
        lines = list(self.doubts)
        for k in np.flatnonzero(self.beyond):
            error, most = self.length_errors_mm[k], wide * self.expanded_mm[k]
            lines.append(f"length {self.names[k]}: off by {error:+.3f} mm, more than {most:.3f} mm")
        if len(self.known_mm) > 1 and abs(self.scale) > wide * self.scale_expanded:
            lines.append(
                f"scale: lengths are {100 * self.scale:+.2f} % off, +- "
                f"{100 * self.scale_expanded:.2f} % (k = 2): calibration or body file is wrong"
            )
        return tuple(lines)


def between_rests(rests: Rests, pairs: Sequence[tuple[int, int]]) -> MeasuredLengths:
    """Distances of the body's origin between rests, by their numbers."""
    n = len(pairs)
    found = [rests.displacement(a, b) for a, b in pairs]
    J, middles, single = np.zeros((n, 6 * len(rests))), np.zeros((n, 3)), np.zeros(n)
    for row, ((a, b), moved) in enumerate(zip(pairs, found, strict=True)):
        along = moved.shift_mm / max(moved.distance_mm, 1e-12)
        J[row, 6 * b : 6 * b + 3], J[row, 6 * a : 6 * a + 3] = along, -along
        ends = [rests.rests[k] for k in (a, b)]
        middles[row] = np.mean([end.world_from_body.translation for end in ends], axis=0)
        single[row] = np.sqrt(sum(along @ end.scatter[:3, :3] @ along for end in ends))
    lengths = np.array([moved.distance_mm for moved in found])
    return MeasuredLengths(lengths, J @ rests.covariance @ J.T, middles, single)


def judge(
    names: Sequence[str],
    measured: MeasuredLengths,
    known_mm: Floats,
    known_sd_mm: Floats,
    doubts: tuple[str, ...] = (),
) -> Acceptance:
    """Compare n measured lengths with known ones (n,) and their standard deviations (n,).

    What the rig already says against itself, its `doubts`, are contradictions as well.
    """
    errors = measured.lengths_mm - known_mm
    P = measured.covariance + np.diag(known_sd_mm**2)
    square = float(known_mm @ known_mm)
    # As many tests as lengths, and one of their scale; none of them may fail by chance (Sidak).
    tests = len(known_mm) + (len(known_mm) > 1)
    groups = [errors[known_mm == length] for length in np.unique(known_mm)]
    degrees = sum(len(group) - 1 for group in groups)
    if degrees:
        again = float(np.sqrt(sum(len(g) * np.var(g) for g in groups) / degrees))
    else:
        again = float(np.sqrt(np.mean(measured.single_sd_mm**2)))
    return Acceptance(
        tuple(names),
        known_mm,
        errors,
        COVERAGE_FACTOR * np.sqrt(np.diag(P)),
        measured.middles_mm,
        float(np.sqrt(np.mean(errors**2))),
        float(np.max(np.abs(errors))),
        again,
        degrees + len([g for g in groups if len(g) > 1]),
        float(known_mm @ errors) / square,
        COVERAGE_FACTOR * float(np.sqrt(known_mm @ P @ known_mm)) / square,
        float(stdtrit(_DEGREES, (1 + _COVERAGE ** (1 / tests)) / 2)),
        doubts,
    )


_LEAST_SWING_DEG = 15.0
"""Within fewer degrees the errors of a pose by light stay alike, and turning averages nothing."""
_WORST_TIP_SD_MM = 0.5  # A tip that is known worse, along any axis, is none
_TUKEY = 6.0  # A pose this many standard deviations off has no weight at all
_LEAST_USED = 0.6  # Share of the poses that must agree on the point


@dataclass(frozen=True, eq=False)
class Pivot:
    """A tip."""

    tip_mm: Floats  # (3,) in the body
    tip_covariance: Floats  # (3, 3) in mm^2
    point_mm: Floats  # (3,) where it stood, in the world
    rms_mm: float  # of the tip's distance from there, over the poses used
    normalised: float  # mean squared distance over what the poses' covariances say; 1 is right
    poses: int  # how many were used
    left_out: int  # how many were not, for they disagree
    swing_deg: float  # opening of a filled cone that shows as much, in its narrowest direction
    needed_deg: float  # how far it must be turned at least

    @property
    def tip_sd_mm(self) -> float:
        """Standard deviation of the tip, 3-D."""
        return float(np.sqrt(np.trace(self.tip_covariance)))


@dataclass(frozen=True, eq=False)
class SpinAxis:
    """The axis about which a body was spun."""

    direction: Floats  # (3,) unit vector in the body, from the tip towards the balls
    sd_deg: float  # its standard deviation across
    turned_deg: float  # how far the body was turned about it


def find_tip(poses: PoseTable, shared: SharedErrors) -> Pivot:
    """The body's point that stays while it turns; DegenerateGeometryError if poses show none."""
    _refuse_few(poses)
    swing = _full_cone_deg(np.linalg.eigvalsh(_turning(poses.world_from_body.rotation))[0])
    if swing < _LEAST_SWING_DEG:
        raise DegenerateGeometryError(_too_little(swing, _LEAST_SWING_DEG))
    tip, point, weights = _fit(poses)
    used = weights > 0
    if np.mean(used) < _LEAST_USED:
        raise DegenerateGeometryError(
            f"no point of the body stays where it is: only {used.sum()} of {len(poses)} poses "
            "agree on one; record the pivoting alone, with the tip in a hole that holds it"
        )
    kept = poses.take(np.flatnonzero(used))
    covariance, normalised = _tip_covariance(kept, tip, point, shared)
    rms = rms_length(kept.world_from_body.apply(tip) - point)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    needed = max(_LEAST_SWING_DEG, swing * worst / _WORST_TIP_SD_MM)
    if swing < needed and normalised > CLEAR_RATIO**2:
        raise DegenerateGeometryError(
            f"the tip does not stay where it is: it wanders by {rms:.2f} mm RMS, "
            f"{np.sqrt(normalised):.0f} times what the poses state; hold it in a small hole"
        )
    if swing < needed:
        raise DegenerateGeometryError(_too_little(swing, needed))
    left_out = len(poses) - len(kept)
    return Pivot(tip, covariance, point, rms, normalised, len(kept), left_out, swing, needed)


def find_spin_axis(poses: PoseTable, shared: SharedErrors, tip_mm: Floats) -> SpinAxis:
    """The body's direction that stays while it is spun; DegenerateGeometryError if none does."""
    _refuse_few(poses)
    values, axes = np.linalg.eigh(_turning(poses.world_from_body.rotation))
    axis = axes[:, 0]
    turned = _full_cone_deg(values[1])
    if turned < _LEAST_SWING_DEG or values[0] > 0.1 * values[1]:
        raise DegenerateGeometryError(
            f"the body was turned by {turned:.0f} deg about the axis and by "
            f"{_full_cone_deg(values[0]):.0f} deg across: at least {_LEAST_SWING_DEG:.0f} "
            "deg about one axis alone are needed"
        )
    P = _axis_covariance(poses, axes, values, shared)
    direction = axis if axis @ (shared.body.middle - tip_mm) >= 0 else -axis
    return SpinAxis(direction, float(np.degrees(np.sqrt(np.trace(P)))), _turned_deg(poses, axis))


def _refuse_few(poses: PoseTable) -> None:
    if len(poses) < FEWEST:
        raise DegenerateGeometryError(
            f"a turning body is seen in {len(poses)} poses that can be relied on: at least "
            f"{FEWEST} are needed"
        )


def _too_little(swing_deg: float, needed_deg: float) -> str:
    return (
        f"the body was turned by {swing_deg:.0f} deg in its narrowest direction, and at least "
        f"{np.ceil(needed_deg):.0f} deg are needed to show its tip: tilt it further, to all sides"
    )


def _turning(rotations: Floats) -> Floats:
    """Mean square (3, 3) of how directions of the body move in the world."""
    centred = rotations - rotations.mean(axis=0)
    return np.asarray(np.einsum("nji,njk->ik", centred, centred) / len(centred))


def _full_cone_deg(mean_square: float) -> float:
    """Opening angle of an evenly filled cone in which directions across it move as much."""
    return 4 * float(np.degrees(np.sqrt(max(mean_square, 0.0))))


def _turned_deg(poses: PoseTable, axis: Floats) -> float:
    """How far a body was turned about an axis of its own, over all poses."""
    turns = (poses.world_from_body[:1].inverse() @ poses.world_from_body).quat_wxyz
    return float(np.degrees(np.ptp(np.unwrap(2 * np.arctan2(turns[:, 1:] @ axis, turns[:, 0])))))


def _fit(poses: PoseTable) -> tuple[Floats, Floats, Floats]:
    """Tip (3,) in the body, point (3,) in the world, weights (n,)."""
    measured = poses.world_from_body
    rows = np.concatenate([measured.rotation, np.broadcast_to(-np.eye(3), (len(poses), 3, 3))], 2)
    x = np.linalg.lstsq(rows.reshape(-1, 6), -measured.translation.reshape(-1))[0]
    adjusted, v, weights = measured, np.zeros((len(poses), 6)), np.ones(len(poses))
    for _ in range(MAX_STEPS):
        A, H, inverse = _linearised(adjusted, x[:3], poses.covariances)
        w = adjusted.apply(x[:3]) - x[3:] + np.einsum("nij,nj->ni", H, v)
        squares = np.einsum("ni,nij,nj->n", w, inverse, w)
        scale = max(np.median(squares) / chi_square_quantile(0.5, 3), 1e-300)
        weights = tukey_weights(squares / scale, _TUKEY)
        weighted = np.swapaxes(A, 1, 2) @ (weights[:, None, None] * inverse)
        step = -np.linalg.solve((weighted @ A).sum(axis=0), np.einsum("nij,nj->i", weighted, w))
        x = x + step
        rest = np.einsum("nij,nj->ni", inverse, w + A @ step)
        v = np.einsum("nij,nkj,nk->ni", poses.covariances, H, rest)
        v[weights == 0] = 0.0
        adjusted = measured.perturb(-v)
        if np.max(np.abs(step)) < 1e-5:
            break
    return x[:3], x[3:], weights


def _linearised(
    adjusted: RigidTransform, tip: Floats, covariances: Floats
) -> tuple[Floats, Floats, Floats]:
    """Of R p + t - q: derivatives (n, 3, 6) by p and q, and by the pose; inverse covariances."""
    R = adjusted.rotation
    unit = np.broadcast_to(np.eye(3), R.shape)
    A, H = np.concatenate([R, -unit], axis=2), np.concatenate([unit, -skew(R @ tip)], axis=2)
    return A, H, np.asarray(np.linalg.inv(propagate(H, covariances)), dtype=np.float64)


def _tip_covariance(
    poses: PoseTable, tip: Floats, point: Floats, shared: SharedErrors
) -> tuple[Floats, float]:
    """Covariance (3, 3) of the tip, and how large residuals are compared with what is stated."""
    A, H, inverse = _linearised(poses.world_from_body, tip, poses.covariances)
    weighted = np.swapaxes(A, 1, 2) @ inverse
    gains = np.linalg.solve((weighted @ A).sum(axis=0), weighted @ H)[:, :3]
    residuals = poses.world_from_body.apply(tip) - point
    white = np.einsum("nji,nj->ni", np.linalg.cholesky(inverse), residuals)
    normalised = float(np.mean(white**2) * len(poses) / (len(poses) - 2))
    scatter = float(np.mean(np.diff(white, axis=0) ** 2) / 2)
    # What does not scatter from pose to pose and is larger than stated: a tip that creeps.
    excess = max(normalised / max(scatter, 1.0), 1.0)
    return shared.of_sum(gains, poses, scatter) * excess, normalised


def _axis_covariance(
    poses: PoseTable, axes: Floats, values: Floats, shared: SharedErrors
) -> Floats:
    """Covariance (3, 3) of the first of `axes` (3, 3), about which the body was spun.

    An error w of a rotation R moves the axis a, as the world sees it, by w x R a.
    """
    R = poses.world_from_body.rotation
    lever = -skew(R @ axes[:, 0])
    gains = np.zeros((len(poses), 3, 6))
    across = axes[:, 1:] / (len(poses) * values[1:]) @ axes[:, 1:].T
    gains[:, :, 3:] = across @ np.swapaxes(R - R.mean(axis=0), 1, 2) @ lever
    seen = R @ axes[:, 0]
    stated = np.trace(propagate(lever, poses.covariances[:, 3:, 3:]), axis1=1, axis2=2)
    scatter = np.mean(np.sum(np.diff(seen, axis=0) ** 2, axis=1)) / (2 * np.mean(stated))
    return shared.of_sum(gains, poses, float(scatter))

"""The clock of a truth that was recorded by another system, and its frames if they are others.

At every offset world and body frame follow from the poses in closed form; from the offsets that
leave least, offset and frames are fitted together.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from measure.arrays import Floats, Ints
from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.limits import CLEAR_RATIO, SPREAD_OVER
from measure.results.run import Run
from measure.results.statistics import AXES
from measure.session import Trajectory

_STEP_S, _LEAST_COMMON_S = 0.02, 0.5
_ARM_MM = 40.0  # A rotation counts with what it displaces a ball
_LEAST_MOTION_MM, _BLOCKS = 2.0, 8
_TRIED, _FEW_STEPS = 5, 10
"""Offsets from which all is fitted, and with how many steps the best is known."""
_MAX_LEFT, _APART_S = 0.2, 0.05
"""Largest RMS of what is left, as a share of the motion; and an offset so far from the best is a
rival if it leaves less than so many times as much."""
FAR_MM, FAR_DEG = 30.0, 20.0
_FAR_MIRRORED_MM, _MIRROR_RATIO = 1.0, 10.0
"""A truth counts as left-handed if it is farther off, and so many times as far as mirrored."""
_MIRROR = np.diag([1.0, -1.0, 1.0])
_LEFT_HANDED = [
    turn
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.diag(signs)[:, order]) < 0
]
"""All ways (3, 3) to exchange and negate axes that turn a right hand into a left one."""


@dataclass(frozen=True)
class TruthOffset:
    """How a truth was brought to a run's clock and frames."""

    offset_s: float  # added to the truth's times
    sd_s: float  # its standard deviation
    frames_fitted: bool  # whether its frames are others than the run's, and were fitted to it
    shift_mm: float  # how far the truth's world was moved, at the run's middle
    turn_deg: float  # how far it was turned

    def note(self) -> str:
        """A line for the user."""
        frames = "its frames are as they were"
        if self.frames_fitted:
            frames = (
                f"its world ({self.shift_mm:.0f} mm and {self.turn_deg:.0f} deg off) and its body "
                "frame were fitted to the run, so errors are what is left after that"
            )
        added = f"{1e3 * self.offset_s:+.1f} +- {1e3 * self.sd_s:.1f} ms"
        return f"{added} were added to the truth's times; {frames}"


def align_truth(run: Run, truth: Trajectory) -> tuple[Trajectory, TruthOffset]:
    """The truth on the run's clock and in its frames, and how it came there.

    RunError: too little motion in common, none that agrees, or motion that repeats itself.
    """
    fits = _fits(run, truth)
    if not fits or fits[0][0] > _MAX_LEFT:
        mirrored = _fits(run, _mirrored(truth))
        if mirrored and mirrored[0][0] < _MAX_LEFT:
            world = _frames(mirrored[0][2])[0]
            cure = _mirror_cure(world.rotation @ _MIRROR)
            raise RunError(
                f"{truth.source} is left-handed: it moves as {run.path} does only if it is "
                f"mirrored; {cure}"
            )
        raise RunError(
            f"no offset makes {truth.source} move as {run.path} does: does the body move, and is "
            "it the truth of this run, of this body, and in mm?"
        )
    least, offset_s, x, problem = fits[0]
    for left, rival_s, *_ in fits[1:]:
        if abs(rival_s - offset_s) > _APART_S and left < CLEAR_RATIO * least:
            raise RunError(
                f"the motion fits offsets of the truth's clock of {offset_s:.2f} s and "
                f"{rival_s:.2f} s alike, as it repeats itself or is too short: shift the truth's "
                "times yourself"
            )
    return problem.moved(x)


def mirror_notes(source: str, measured: RigidTransform, true: RigidTransform) -> list[str]:
    """That a truth is left-handed, and which axis, if it is off as it stands and fits mirrored."""
    if len(measured.translation) < 3:
        return []

    def off_mm(turn: Floats) -> float:
        off = true.translation @ turn.T - measured.translation
        return float(np.median(np.linalg.norm(off, axis=1)))

    as_it_is, mirrored = off_mm(np.eye(3)), {k: off_mm(m) for k, m in enumerate(_LEFT_HANDED)}
    best = min(mirrored, key=lambda k: mirrored[k])
    if as_it_is < _FAR_MIRRORED_MM or as_it_is < _MIRROR_RATIO * mirrored[best]:
        return []
    note = (
        f"{source} is left-handed: half of its positions are more than {as_it_is:.3g} mm off as it "
        f"stands, which is compared here, and {mirrored[best]:.2g} mm if it is mirrored; "
        f"{_mirror_cure(_LEFT_HANDED[best])}"
    )
    return [note]


def _mirrored(truth: Trajectory) -> Trajectory:
    poses = truth.world_from_body
    rotations = _MIRROR @ poses.rotation @ _MIRROR
    moved = RigidTransform(rotations, poses.translation @ _MIRROR)
    return replace(truth, world_from_body=moved)


def _mirror_cure(right_from_left: Floats) -> str:
    """What to do with a truth's axes, by the signed permutation next to a matrix (3, 3)."""
    nearest = max(_LEFT_HANDED, key=lambda m: float(np.sum(m * right_from_left)))
    if np.array_equal(np.abs(nearest), np.eye(3)) and np.trace(nearest) == 1:
        flipped = AXES[int(np.argmin(np.diag(nearest)))]
        turns = " and ".join(f"q{axis}" for axis in AXES if axis != flipped)
        return f"its {flipped} axis points the other way: negate {flipped}, {turns}"
    order, signs = np.abs(nearest).argmax(axis=1), nearest.sum(axis=1)
    named = ", ".join(f"{'-' if s < 0 else ''}{AXES[k]}" for k, s in zip(order, signs, strict=True))
    return f"take its {named} for x, y, z, and the quaternion's, all negated"


def _fits(run: Run, truth: Trajectory) -> list[tuple[float, float, Floats, _Problem]]:
    """What is left, offset, parameters and problem of the offsets that fit best, from the best."""
    times = run.times_s[run.has_pose]
    few = np.unique(np.linspace(0, len(times) - 1, min(len(times), SPREAD_OVER)).astype(int))
    if not len(times):
        raise RunError(f"{run.path} holds no pose: there is nothing to find the truth's clock by")
    first, last = times[0] - truth.times_s[-1], times[-1] - truth.times_s[0]
    lags = np.arange(first + _LEAST_COMMON_S, last - _LEAST_COMMON_S, _STEP_S)
    rough = np.full(len(lags) + 2, np.inf)
    for k, lag_s in enumerate(lags, start=1):
        problem = _Problem.of(run, truth, lag_s, few)
        if problem is not None:
            rough[k] = problem.left(problem.start(lag_s))
    low = np.flatnonzero((rough[1:-1] <= rough[:-2]) & (rough[1:-1] < rough[2:]))
    fits = []
    for k in low[np.argsort(rough[1:-1][low])][:_TRIED]:
        problem = _Problem.of(run, truth, lags[k])
        if problem is not None:
            x = problem.solved(problem.start(lags[k]), _FEW_STEPS).x
            fits.append((problem.left(x), float(x[0]), x, problem))
    fits.sort(key=lambda fit: fit[0])
    return fits


@dataclass(frozen=True, eq=False)
class _Problem:
    """Poses of the run against those of the truth, by offset (1), world (6) and body frame (6)."""

    times_s: Floats
    measured: RigidTransform
    truth: Trajectory

    @classmethod
    def of(
        cls, run: Run, truth: Trajectory, lag_s: float, some: Ints | slice = slice(None)
    ) -> _Problem | None:
        """With those of the run's poses that have the truth near; None if too few move enough."""
        times = run.times_s[run.has_pose][some] - lag_s
        kept = truth.covers(times - _STEP_S) & truth.covers(times + _STEP_S)
        poses = run.world_from_body
        rotations, places = poses.rotation[some][kept], poses.translation[some][kept]
        made = cls(times[kept] + lag_s, RigidTransform(rotations, places), truth)
        moves = kept.sum() >= _BLOCKS and made.motion_mm > _LEAST_MOTION_MM
        return made if moves and np.ptp(times[kept]) > _LEAST_COMMON_S else None

    @property
    def motion_mm(self) -> float:
        """RMS displacement of a ball from where it was in the middle."""
        p = self.measured
        middle = p[len(p.translation) // 2]
        return float(np.sqrt(np.mean(_displacements(p.difference(middle)) ** 2)))

    def moved(self, x: Floats) -> tuple[Trajectory, TruthOffset]:
        """The truth by the fit from there; by its times alone if its frames are the run's own."""
        fit = self.solved(x)
        world, body = _frames(fit.x)
        middle = self.measured.translation.mean(axis=0)
        shift = float(np.linalg.norm(world.apply(middle) - middle))
        turn, own = (float(np.degrees(np.linalg.norm(one.rotvec))) for one in (world, body))
        far_mm = max(shift, float(np.linalg.norm(body.translation)))
        moved = world @ self.truth.world_from_body @ body
        fitted = far_mm > FAR_MM or max(turn, own) > FAR_DEG
        if not fitted:
            shift, turn, moved = 0.0, 0.0, self.truth.world_from_body
            fit = self.solved(fit.x[:1])
        sd_s = _first_sd(np.asarray(fit.jac), fit.fun)
        offset = TruthOffset(float(fit.x[0]), sd_s, fitted, shift, turn)
        times_s = self.truth.times_s + fit.x[0]
        return replace(self.truth, times_s=times_s, world_from_body=moved), offset

    def left(self, x: Floats) -> float:
        """RMS of the residuals as a share of the motion."""
        return float(np.sqrt(np.mean(self.residuals(x) ** 2))) / self.motion_mm

    def solved(self, x: Floats, steps: int | None = None) -> OptimizeResult:
        """The fit of as many parameters as are given, from there, with at most so many steps."""
        return least_squares(self.residuals, x, loss="soft_l1", x_scale="jac", max_nfev=steps)

    def start(self, lag_s: float) -> Floats:
        """Rotations from relative rotations' axes (Park and Martin 1994), then translations."""
        true = self.truth.at(self.times_s - lag_s)
        a, b = Rotation.from_matrix(self.measured.rotation), Rotation.from_matrix(true.rotation)
        far = int(np.argmax((a[0].inv() * a).magnitude()))
        ours, theirs = (
            np.concatenate([(r * r[k].inv()).as_rotvec() for k in (0, far)]) for r in (a, b)
        )
        world, _ = Rotation.align_vectors(ours, theirs)
        body = ((world * b).inv() * a).mean()
        turn = world.as_matrix()
        left = np.concatenate(
            [np.broadcast_to(np.eye(3), true.rotation.shape), turn @ true.rotation], axis=2
        )
        right = self.measured.translation - true.translation @ turn.T
        shifts = np.linalg.lstsq(left.reshape(-1, 6), right.reshape(-1))[0]
        return np.hstack([lag_s, shifts[:3], world.as_rotvec(), shifts[3:], body.as_rotvec()])

    def residuals(self, x: Floats) -> Floats:
        """In mm."""
        world, body = _frames(x)
        there = np.clip(self.times_s - x[0], self.truth.times_s[0], self.truth.times_s[-1])
        return _displacements((world @ self.truth.at(there) @ body).difference(self.measured))


def _frames(x: Floats) -> tuple[RigidTransform, RigidTransform]:
    """`run_world_from_truth_world` and `truth_body_from_run_body`; the identity if not fitted."""
    x = np.pad(x, (0, 13 - len(x)))
    world = RigidTransform.from_rotvec(x[4:7], x[1:4])
    return world, RigidTransform.from_rotvec(x[10:13], x[7:10])


def _first_sd(j: Floats, r: Floats) -> float:
    """Of the first parameter: from the residuals, and by a jackknife over blocks of them."""
    normal = j.T @ j
    variance = np.linalg.pinv(normal)[0, 0] * (r @ r) / max(len(r) - len(normal), 1)
    blocks = np.array_split(np.arange(len(r)), _BLOCKS)
    without = [np.linalg.pinv(normal - j[b].T @ j[b]) @ (j[b].T @ r[b]) for b in blocks]
    return float(np.sqrt(variance + (_BLOCKS - 1) * np.var([step[0] for step in without])))


def _displacements(difference: Floats) -> Floats:
    """Differences (n, 6) of poses as displacements (6 n,) of a ball, mm."""
    return np.concatenate([difference[:, :3], _ARM_MM * difference[:, 3:]], axis=1).reshape(-1)

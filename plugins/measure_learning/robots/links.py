"""Errors of a chain's links, and how large they are.

Link k is followed by a small error in its joint's frame: six numbers, x y z in mm and a rotation
vector in rad. Along the joint's axis these are the classical offsets d and theta; they describe
tables of Denavit and Hartenberg, URDF and any other description alike. No motion shows all of them.
They are held as random effects: normal, with a standard deviation for lengths and one for angles,
which are estimated too (Harville 1977, JASA 72, 320).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.geometry import RigidTransform, skew
from measure.geometry.covariance import posterior_covariance
from measure.limits import MAX_STEPS
from measure.robots import SerialChain

PARAMETERS = ("x_mm", "y_mm", "z_mm", "x_deg", "y_deg", "z_deg")
"""What a link can be off by, in its joint's frame."""
TURNS = np.array([False] * 3 + [True] * 3)
"""Which of these are angles."""
_USUAL_SD = np.array([0.3, 5e-4])  # mm and rad: the least that is counted with
_LARGEST_SD = np.array([5.0, 0.05])  # mm and rad: the most that is counted with, whatever is left
_LEAST_NOISE = 1e-2
"""Variance of what is left over what is stated, at least: few residuals may be met exactly."""
_SAME_SD = 1e-3  # relative change of the links' standard deviations, below which they are found


def link_names(chain: SerialChain) -> tuple[str, ...]:
    """Names of all link errors (6 joints), from `link1_x_mm` on."""
    return tuple(f"link{k + 1}_{name}" for k in range(chain.size) for name in PARAMETERS)


def with_link_errors(chain: SerialChain, errors: ArrayLike) -> SerialChain:
    """The chain whose links are off by `errors` (6 joints), in mm and rad."""
    moves = floats("errors", errors, 6 * chain.size).reshape(-1, 6)
    off = RigidTransform.from_rotvec(moves[:, 3:], moves[:, :3]).matrix
    joints = [replace(j, link=j.link @ m) for j, m in zip(chain.joints, off, strict=True)]
    return replace(chain, joints=tuple(joints))


def link_jacobian(chain: SerialChain, q: ArrayLike) -> Floats:
    """Derivative of `chain.pose(q)` by the link errors: (n, 6, 6 joints), q is (n, joints).

    Rows are those of `RigidTransform.perturb`, as in `SerialChain.jacobian`.
    """
    frames = chain.frames(q)
    tip = frames[:, -1, :3, 3]
    out = np.zeros((len(frames), 6, 6 * chain.size))
    before = np.broadcast_to(np.eye(4), (len(frames), 4, 4))
    for k, joint in enumerate(chain.joints):
        frame = before @ joint.link
        turn, lever = frame[:, :3, :3], tip - frame[:, :3, 3]
        at = 6 * k
        out[:, :3, at : at + 3] = out[:, 3:, at + 3 : at + 6] = turn
        out[:, :3, at + 3 : at + 6] = -skew(lever) @ turn
        before = frames[:, k]
    return out


def usual_sd(count: int) -> Floats:
    """Standard deviations of `count` link errors before anything is known of them."""
    return np.resize(_USUAL_SD[TURNS.astype(int)], count)


@dataclass(frozen=True, eq=False)
class LinkEffects:
    """A step towards the most likely parameters; the last ones are link errors."""

    step: Floats  # (m,)
    covariance: Floats  # (m, m)
    link_sd: Floats  # (links,) of the link errors before they are fitted
    noise: float  # variance of what is left, over what is stated

    def solved(
        self,
        normal: tuple[Floats, Floats, float, int],
        known: Floats,
        links: Floats,
        share: float = 1.0,
    ) -> LinkEffects:
        """Solve normal equations, by expectation and maximisation from these deviations on.

        Args:
            normal: matrix (m, m) and right side (m,) of whitened slopes and residuals, the
                residuals' sum of squares, and how many they are.
            known: (m - links,) inverse variances of the other parameters; 0 where all is open.
            links: (links,) errors at which the residuals were taken.
            share: of the residuals that are independent.
        """
        N, g, squares, count = normal
        size, sd, noise = len(links), self.link_sd, self.noise
        for _ in range(MAX_STEPS):
            precision = np.concatenate([known, sd**-2.0])
            C = posterior_covariance(N * (share / noise), precision)
            pull = g * (share / noise)
            pull[len(pull) - size :] -= precision[len(pull) - size :] * links
            x = C @ pull
            before = sd
            sd = _pooled((links + x[len(x) - size :]) ** 2, np.diag(C)[len(x) - size :])
            left = float(squares - 2 * x @ g + x @ N @ x + share * np.sum(C * N)) / count
            noise = max(left, _LEAST_NOISE)
            if np.abs(sd / before - 1).max(initial=0.0) < _SAME_SD:
                break
        return LinkEffects(x, np.asarray(C, dtype=np.float64), sd, noise)


def _pooled(squares: Floats, variances: Floats) -> Floats:
    """Standard deviations (links,): one of all lengths, one of all angles.

    Of squared errors and of their variances, which are those of the prior where nothing shows an
    error: what is not shown leaves the deviation as it is.
    """
    turns = np.resize(TURNS, squares.shape)
    out, second = np.empty_like(squares), squares + np.maximum(variances, 0.0)
    for which, usual, most in zip((~turns, turns), _USUAL_SD, _LARGEST_SD, strict=True):
        if which.any():
            out[which] = np.clip(np.sqrt(second[which].mean()), usual, most)
    return out

"""Levenberg-Marquardt for calibration: shared parameters plus many small blocks of their own.

Cameras, lenses and marker positions are *shared*; the pose of one board view or of the body in one
frame set is a *block* that only its own observations touch. Eliminating the blocks first (the Schur
complement, Triggs et al. 2000, "Bundle Adjustment", section 6.3) leaves a dense system in the
shared parameters, whose inverse is their covariance. Everything runs in a fixed order in one
thread: the same input gives the same answer to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import CalibrationError
from measure.estimation.losses import Huber

State = TypeVar("State")

_MAX_DAMPING = 1e12
_MIN_DAMPING = 1e-15
_UNSEEN = "a view or frame has too few observations to fix its own pose"
_UNDETERMINED = (
    "the observations leave calibration parameters undetermined: add views from other angles, or "
    "fix more of the lens"
)


@dataclass(frozen=True, eq=False)
class Group:
    """Whitened observations that depend on the same shared parameters (as a rule: one camera's)."""

    residuals: Floats  # (n, k) observed minus predicted, divided by their standard deviations
    columns: Ints  # (p,) which shared parameters they depend on
    by_shared: Floats  # (n, k, p) derivative of the whitened prediction by those
    block: Ints  # (n,) which block each depends on; empty if there are no blocks
    by_block: Floats  # (n, k, b) derivative of the whitened prediction by that block


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem linearised at a state."""

    groups: tuple[Group, ...]
    n_shared: int
    n_blocks: int
    prior_residuals: Floats  # (m,) whitened residuals of the priors
    prior_by_shared: Floats  # (m, n_shared) derivative of the whitened prior predictions

    @property
    def residuals(self) -> Floats:
        """All whitened observation residuals, flat."""
        return np.concatenate([group.residuals.reshape(-1) for group in self.groups])

    @property
    def size_of_block(self) -> int:
        """Parameters in a block."""
        return self.groups[0].by_block.shape[2]


@dataclass(frozen=True)
class StoppingRule:
    """When Levenberg-Marquardt stops."""

    steps: int = 300  # most steps to take; those that are tried in vain do not count
    tolerance: float = 1e-10  # settled once a step lowers the cost by less than this share
    must_settle: bool = True
    # to start with, as a share of the diagonal. Parameters that only a weak prior holds hardly move
    # before it has fallen below the prior's share.
    damping: float = 1e-4


@dataclass(frozen=True, eq=False)
class LeastSquaresSolution(Generic[State]):
    """Where Levenberg-Marquardt ended."""

    state: State
    linearised: Linearised
    # (n_shared, n_shared) of the shared parameters, for whitened residuals of standard deviation 1.
    covariance: Floats
    cost: float  # sum of losses and squared priors
    loss: Huber

    @property
    def variance_factor(self) -> float:
        """Sum of squared residuals over degrees of freedom: 1 where the stated sds are right."""
        lin = self.linearised
        squares = np.sum(lin.residuals**2) + np.sum(lin.prior_residuals**2)
        rows = lin.residuals.size + lin.prior_residuals.size
        unknowns = lin.n_shared + lin.n_blocks * lin.size_of_block
        return float(squares / max(rows - unknowns, 1))

    @property
    def clustered_factor(self) -> float:
        """The variance factor if errors within a block are alike, as those of one view may be.

        By the sandwich covariance with blocks as clusters (Liang and Zeger 1986, Biometrika 73,
        equation 8): with S the inverse covariance and g_f what block f adds to the gradient,
        tr(S^-1 sum g_f g_f^T) f / (f - 1) over the shared parameters' number. Its mean is below
        `variance_factor` where errors are independent.
        """
        lin, f, p = self.linearised, self.linearised.n_blocks, self.linearised.n_shared
        if f < 2 or not p:
            return 0.0
        normal, gradient = _normal_equations(lin, self.loss), np.zeros((f, p))
        for group in lin.groups:
            weights = self.loss.weights(np.linalg.norm(group.residuals, axis=1))
            each = np.einsum("n,nkp,nk->np", weights, group.by_shared, group.residuals)
            np.add.at(gradient, (group.block[:, None], group.columns), each)
        own = _solve_scaled(normal.V, normal.W, _UNSEEN)
        gradient -= np.einsum("fbp,fb->fp", own, normal.h)
        return float(np.einsum("fp,pq,fq->", gradient, self.covariance, gradient) / p * f / (f - 1))


def solve(
    linearise: Callable[[State], Linearised],
    step: Callable[[State, Floats, Floats], State],
    start: State,
    loss: Huber | None = None,
    limits: StoppingRule | None = None,
) -> LeastSquaresSolution[State]:
    """Minimise the sum of losses of the whitened residuals plus the squared priors.

    `step` gives the state after shared (n_shared,) and block (n_blocks, b) increments.
    CalibrationError: the start has no finite cost, the data leave parameters undetermined, or the
    limit was reached.
    """
    loss, limits = loss or Huber(), limits or StoppingRule()
    state, here = start, linearise(start)
    cost = _cost(here, loss)
    if not np.isfinite(cost):
        raise CalibrationError("the calibration starts from a pose that cannot see its own targets")
    damping, taken, done = limits.damping, 0, False
    while not done:
        shared, blocks, predicted = _normal_equations(here, loss).increment(damping)
        candidate = step(state, shared, blocks)
        there = linearise(candidate)
        gain = cost - _cost(there, loss)
        done = predicted <= 0.1 * limits.tolerance * cost + 1e-15
        if np.isfinite(gain) and gain >= 0:
            state, here, cost, taken = candidate, there, cost - gain, taken + 1
            damping = max(damping / 10, _MIN_DAMPING)
            done = done or gain <= limits.tolerance * cost
            if not done and taken >= limits.steps and limits.must_settle:
                raise CalibrationError(f"the calibration did not settle in {taken} steps")
            done = done or taken >= limits.steps
        else:
            damping *= 10
            done = done or damping > _MAX_DAMPING
    covariance = _normal_equations(here, loss).covariance()
    return LeastSquaresSolution(state, here, covariance, cost, loss)


def _cost(lin: Linearised, loss: Huber) -> float:
    lengths = np.concatenate([np.linalg.norm(g.residuals, axis=1) for g in lin.groups])
    return loss.cost(lengths) + float(lin.prior_residuals @ lin.prior_residuals)


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """[[U, W^T], [W, V]] [shared, blocks] = [g, h], with V block diagonal."""

    U: Floats
    V: Floats
    W: Floats
    g: Floats
    h: Floats

    def increment(self, damping: float) -> tuple[Floats, Floats, float]:
        """Shared (p,) and block (f, b) increments, and the decrease they promise."""
        U = self.U + damping * np.diag(_scale(np.diag(self.U)))
        V = self.V.copy()
        diagonal = np.einsum("fii->fi", V)
        diagonal += damping * _scale(diagonal)
        both = np.concatenate([self.W, self.h[:, :, None]], axis=2)
        solved = _solve_scaled(V, both, _UNSEEN)
        flat = self.W.reshape(self.h.size, len(self.g)).T
        together = flat @ solved.reshape(flat.shape[1], solved.shape[2])
        reduced, right = U - together[:, :-1], self.g - together[:, -1]
        shared = right
        if len(right):
            shared = _solve_scaled(reduced[None], right[None, :, None], _UNDETERMINED)[0, :, 0]
        blocks = solved[:, :, -1] - solved[:, :, :-1] @ shared
        return shared, blocks, float(self.g @ shared + np.sum(self.h * blocks))

    def covariance(self) -> Floats:
        """Inverse of the Schur complement (p, p)."""
        solved = _solve_scaled(self.V, self.W, _UNSEEN)
        flat = self.W.reshape(self.h.size, len(self.g)).T
        reduced = self.U - flat @ solved.reshape(flat.shape[1], solved.shape[2])
        scale = 1 / np.sqrt(_scale(np.diag(reduced)))
        scaled = reduced * scale[:, None] * scale
        spread = np.linalg.eigvalsh(scaled) if len(scaled) else np.ones(1)
        if not spread[0] > 1e-13 * spread[-1]:
            raise CalibrationError(
                f"the observations leave {int(np.sum(spread < 1e-13 * spread[-1]))} calibration "
                "parameters undetermined: add views from other angles, or fix more of the lens"
            )
        return np.linalg.inv(scaled) * scale[:, None] * scale


def _normal_equations(lin: Linearised, loss: Huber) -> _NormalEquations:
    p, f, b = lin.n_shared, lin.n_blocks, lin.size_of_block
    U = lin.prior_by_shared.T @ lin.prior_by_shared
    g = lin.prior_by_shared.T @ lin.prior_residuals
    V, W, h = np.zeros((f, b, b)), np.zeros((f, b, p)), np.zeros((f, b))
    for group in lin.groups:
        weights = loss.weights(np.linalg.norm(group.residuals, axis=1))
        weighted = group.by_shared * weights[:, None, None]
        rows = group.by_shared.reshape(group.residuals.size, len(group.columns))
        U[np.ix_(group.columns, group.columns)] += rows.T @ weighted.reshape(rows.shape)
        g[group.columns] += weighted.reshape(rows.shape).T @ group.residuals.reshape(-1)
        if f:
            own = np.swapaxes(group.by_block * weights[:, None, None], 1, 2)
            order = np.argsort(group.block, kind="stable")
            blocks, first = np.unique(group.block[order], return_index=True)
            V[blocks] += np.add.reduceat((own @ group.by_block)[order], first)
            h[blocks] += np.add.reduceat((own @ group.residuals[:, :, None])[order, :, 0], first)
            cross = np.add.reduceat((own @ group.by_shared)[order], first)
            W[blocks[:, None], :, group.columns] += np.swapaxes(cross, 1, 2)
    return _NormalEquations(U, V, W, g, h)


class Columns:
    """Numbers the shared parameters, kind after kind."""

    size = 0

    def __call__(self, count: int) -> Ints:
        """The columns of the next `count` parameters."""
        self.size += count
        return np.arange(self.size - count, self.size)


def prior_rows(off: Floats, root: Floats, columns: Ints, size: int) -> tuple[Floats, Floats]:
    """Whitened residual and derivative rows (m, size) of a prior with R^T R its information."""
    rows = np.zeros((len(root), size))
    rows[:, columns] = root
    return root @ off, rows


def root_information(covariance: Floats, jitter: float = 0.0) -> Floats:
    """R with R^T R the inverse of a covariance; `jitter` is added to the correlations' diagonal."""
    scale = 1 / np.sqrt(np.diag(covariance))
    correlation = covariance * scale[:, None] * scale
    if jitter:
        correlation = correlation + jitter * np.eye(len(scale))
    return np.linalg.inv(np.linalg.cholesky(correlation)) * scale


def _scale(diagonal: Floats) -> Floats:
    """A diagonal with its zeros replaced, so that untouched parameters stay put."""
    return np.where(diagonal > 0, diagonal, 1.0)


def _solve_scaled(V: Floats, right: Floats, singular: str) -> Floats:
    """Solve f systems (f, b, b) for (f, b, p); `singular` is the message if one is."""
    if not len(V):
        return right
    scale = 1 / np.sqrt(_scale(np.einsum("fii->fi", V)))
    scaled = V * scale[:, :, None] * scale[:, None, :]
    try:
        return np.linalg.solve(scaled, right * scale[:, :, None]) * scale[:, :, None]
    except np.linalg.LinAlgError:
        raise CalibrationError(singular) from None

"""Levenberg-Marquardt for named blocks of shared parameters, and a small block for each instant.

Cameras, lenses and marker positions are *shared*; the pose of one board view or of the body in one
frame set is of an *instant*, and only its own observations touch it. Eliminating the instants first
(the Schur complement, Triggs et al. 2000, "Bundle Adjustment", section 6.3) leaves a dense system
in the shared parameters, whose inverse is their covariance. Everything runs in a fixed order in one
thread: the same input gives the same answer to the last digit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import CalibrationError
from measure.estimation.losses import Huber

State = TypeVar("State")
Blocks = Mapping[str, Floats]

_MAX_DAMPING = 1e12
_MIN_DAMPING = 1e-15
_UNSEEN = "a view or frame has too few observations to fix its own pose"
_UNDETERMINED = (
    "the observations leave calibration parameters undetermined: add views from other angles, or "
    "fix more of the lens"
)


@dataclass(frozen=True, eq=False)
class Group:
    """Whitened observations that depend on the same shared blocks (as a rule: one camera's)."""

    residuals: Floats  # (n, k) observed minus predicted, divided by their standard deviations
    by_block: Blocks  # by name (n, k, p) derivative of the whitened prediction by a shared block
    instant: Ints  # (n,) which instant each depends on; of no account if there are none
    by_instant: Floats  # (n, k, b) derivative of the whitened prediction by that instant's own

    @cached_property
    def by_shared(self) -> Floats:
        """(n, k, q) derivative by all its shared blocks, one after the other."""
        none = self.by_instant[:, :, :0]
        return np.concatenate([none, *self.by_block.values()], axis=2)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known beforehand of some shared blocks, one after the other."""

    names: tuple[str, ...]
    root: Floats  # (m, q) R with R^T R the information
    off: Floats  # (q,) expected minus present values

    @property
    def residuals(self) -> Floats:
        """(m,) whitened."""
        return self.root @ self.off


@dataclass(frozen=True, eq=False)
class Linearised:
    """A problem linearised at a state."""

    groups: tuple[Group, ...]
    sizes: Mapping[str, int]  # of the shared blocks, by name, in their order
    n_instants: int
    priors: tuple[Prior, ...] = ()

    @property
    def n_shared(self) -> int:
        """Shared parameters."""
        return sum(self.sizes.values())

    @property
    def residuals(self) -> Floats:
        """All whitened observation residuals, flat."""
        return np.concatenate([group.residuals.reshape(-1) for group in self.groups])

    @property
    def size_of_instant(self) -> int:
        """Parameters of an instant."""
        return self.groups[0].by_instant.shape[2]

    @cached_property
    def _columns(self) -> dict[str, Ints]:
        ends = np.cumsum([0, *self.sizes.values()])
        return {
            name: np.arange(start, start + size)
            for (name, size), start in zip(self.sizes.items(), ends[:-1], strict=True)
        }

    def columns(self, names: Iterable[str]) -> Ints:
        """Where some blocks, one after the other, stand among the shared parameters."""
        none = np.zeros(0, dtype=np.int64)
        return np.concatenate([none, *(self._columns[name] for name in names)])


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

    def covariance_of(self, *names: str) -> Floats:
        """(q, q) of some blocks, one after the other."""
        at = self.linearised.columns(names)
        return self.covariance[np.ix_(at, at)]

    @property
    def variance_factor(self) -> float:
        """Sum of squared residuals over degrees of freedom: 1 where the stated sds are right."""
        lin = self.linearised
        residuals = np.concatenate([lin.residuals, *(prior.residuals for prior in lin.priors)])
        unknowns = lin.n_shared + lin.n_instants * lin.size_of_instant
        return float(np.sum(residuals**2) / max(residuals.size - unknowns, 1))

    @property
    def clustered_factor(self) -> float:
        """The variance factor if errors within an instant are alike, as those of one view may be.

        By the sandwich covariance with instants as clusters (Liang and Zeger 1986, Biometrika 73,
        equation 8): with S the inverse covariance and g_f what instant f adds to the gradient,
        tr(S^-1 sum g_f g_f^T) f / (f - 1) over the shared parameters' number. Its mean is below
        `variance_factor` where errors are independent.
        """
        lin, f, p = self.linearised, self.linearised.n_instants, self.linearised.n_shared
        if f < 2 or not p:
            return 0.0
        normal, gradient = _normal_equations(lin, self.loss), np.zeros((f, p))
        for group in lin.groups:
            weights = self.loss.weights(np.linalg.norm(group.residuals, axis=1))
            each = np.einsum("n,nkp,nk->np", weights, group.by_shared, group.residuals)
            np.add.at(gradient, (group.instant[:, None], lin.columns(group.by_block)), each)
        own = _solve_scaled(normal.V, normal.W, _UNSEEN)
        gradient -= np.einsum("fbp,fb->fp", own, normal.h)
        return float(np.einsum("fp,pq,fq->", gradient, self.covariance, gradient) / p * f / (f - 1))


def solve(
    linearise: Callable[[State], Linearised],
    step: Callable[[State, Blocks, Floats], State],
    start: State,
    loss: Huber | None = None,
    limits: StoppingRule | None = None,
) -> LeastSquaresSolution[State]:
    """Minimise the sum of losses of the whitened residuals plus the squared priors.

    `step` gives the state after increments of the shared blocks (p,), by name, and of the instants
    (n_instants, b). CalibrationError: the start has no finite cost, the data leave parameters
    undetermined, or the limit was reached.
    """
    loss, limits = loss or Huber(), limits or StoppingRule()
    state, here = start, linearise(start)
    cost = _cost(here, loss)
    if not np.isfinite(cost):
        raise CalibrationError("the calibration starts from a pose that cannot see its own targets")
    damping, taken, done = limits.damping, 0, False
    while not done:
        shared, own, predicted = _normal_equations(here, loss).increment(damping)
        candidate = step(state, {name: shared[here.columns([name])] for name in here.sizes}, own)
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
    return loss.cost(lengths) + float(sum(p.residuals @ p.residuals for p in lin.priors))


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """[[U, W^T], [W, V]] [shared, instants] = [g, h], with V block diagonal."""

    U: Floats
    V: Floats
    W: Floats
    g: Floats
    h: Floats

    def increment(self, damping: float) -> tuple[Floats, Floats, float]:
        """Increments of shared (p,) and of instants (f, b), and the decrease they promise."""
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
        own = solved[:, :, -1] - solved[:, :, :-1] @ shared
        return shared, own, float(self.g @ shared + np.sum(self.h * own))

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
    p, f, b = lin.n_shared, lin.n_instants, lin.size_of_instant
    U, g = np.zeros((p, p)), np.zeros(p)
    V, W, h = np.zeros((f, b, b)), np.zeros((f, b, p)), np.zeros((f, b))
    for prior in lin.priors:
        columns = lin.columns(prior.names)
        U[np.ix_(columns, columns)] += prior.root.T @ prior.root
        g[columns] += prior.root.T @ prior.residuals
    for group in lin.groups:
        columns, by_shared = lin.columns(group.by_block), group.by_shared
        weights = loss.weights(np.linalg.norm(group.residuals, axis=1))
        weighted = by_shared * weights[:, None, None]
        rows = by_shared.reshape(group.residuals.size, len(columns))
        U[np.ix_(columns, columns)] += rows.T @ weighted.reshape(rows.shape)
        g[columns] += weighted.reshape(rows.shape).T @ group.residuals.reshape(-1)
        if f:
            own = np.swapaxes(group.by_instant * weights[:, None, None], 1, 2)
            V += summed(own @ group.by_instant, group.instant, f)
            h += summed((own @ group.residuals[:, :, None])[:, :, 0], group.instant, f)
            W[:, :, columns] += summed(own @ by_shared, group.instant, f)
    return _NormalEquations(U, V, W, g, h)


def summed(rows: Floats, instant: Ints, count: int) -> Floats:
    """Sums (count, ...) of the rows (n, ...) of each instant."""
    order = np.argsort(instant, kind="stable")
    seen, first = np.unique(instant[order], return_index=True)
    out = np.zeros((count, *rows.shape[1:]))
    out[seen] = np.add.reduceat(rows[order], first)
    return out


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

"""Offsets of zeros, links and base: from a stretch measured after a restart, and followed later."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from measure.arrays import Floats, floats
from measure.errors import EstimatorError
from measure.estimation.blocks import fit_blocks
from measure.estimation.losses import HUBER_SIGMAS, Huber
from measure.host import Correction
from measure.limits import FEWEST
from measure.robots import SerialChain, StateSchema
from measure_learning.robots.links import TURNS, link_jacobian, with_link_errors

OFFSET_SD_MM = 0.9  # per axis, of the tip's mean offset after a restart, where not learnt
_OFFSET_LIMITS_MM = 0.15, 3.5
_MIN_INDEPENDENT = 12.0  # observations, as their autocorrelation counts them
_CONVINCING = 0.15  # share of the squares left of parts by the others' zeros that is proof enough
_APART = 0.6  # independent ones among them from which on poses are far apart in time
_IN_A_ROW = 0.5  # what others count as: their errors are alike for longer than they show
_PARTS = 10  # left out in turn
_CHANCE = 4.0  # over the number of states: how much worse parts may do by chance
_MIN_SPREAD = 0.5  # of the joints' SDs, as a share of those in training
_APART_SPREAD = 0.15  # the same of poses far apart: they are spread as the session is
_LEAST_LEVER_MM = 5.0  # of a joint, which scales its offset
_CURE = "measure ten poses or more, spread over the workspace"
_MIN_SCALE_MM = 0.05


@dataclass(frozen=True, eq=False)
class Zeroing:
    """A correction of joint zeros, links and base, on top of a model's.

    A constant offset of a joint is not constant at the tip: it depends on the pose. So where the
    kinematics are known, the chain is corrected.
    """

    # (6 k,) errors of the links, in which zeros and base are, as `with_link_errors` takes them;
    # without kinematics (3,) mm of the tip, the same everywhere.
    errors: Floats
    spread: Floats  # covariance of these
    readings: Floats  # (features, k) from a state to the joints
    chain: SerialChain | None  # the robot's kinematics, if known
    mean_mm: Floats  # (3,) the offset of the tip, averaged over the stretch
    covariance: Floats  # (3, 3) mm^2 of the offset, averaged over the stretch
    held_out_mm: Floats  # (n, 3) what the offsets of other parts leave of the stretch's residuals

    @property
    def sd_mm(self) -> float:
        """3-D standard deviation of the offset."""
        return float(np.sqrt(np.trace(self.covariance)))

    def offset_mm(self, states: Floats) -> Floats:
        """Offset (..., 3) in mm to add to the corrections of states (..., features)."""
        if self.chain is None:
            return np.broadcast_to(self.errors, (*states.shape[:-1], 3))
        q = states @ self.readings
        return self.today.tip_mm(q) - self.chain.tip_mm(q)

    @cached_property
    def today(self) -> SerialChain:
        """The chain with the links, zeros and base of today: its tip is off by `offset_mm`."""
        assert self.chain is not None
        return with_link_errors(self.chain, self.errors)

    def joints(self) -> tuple[Floats, Floats]:
        """What to add to the joints (k,), rad and mm, and its SDs: the links' parts along them."""
        assert self.chain is not None
        along = np.zeros((self.chain.size, len(self.errors)))
        for k, joint in enumerate(self.chain.joints):
            first = 6 * k + (0 if joint.prismatic else 3)
            along[k, first : first + 3] = joint.axis
        variances = np.einsum("kp,pq,kq->k", along, self.spread, along)
        return along @ self.errors, np.sqrt(variances)


def fit_zeroing(
    schema: StateSchema,
    states: Floats,
    residuals_mm: Floats,
    *,
    offset_sd_mm: float = OFFSET_SD_MM,
    spread_sd: Floats | None = None,
    or_none: bool = False,
) -> Zeroing:
    """The offsets that explain a stretch's residuals (n, 3), measured minus corrected position.

    Bayesian linear regression with Huber's weights on all errors of the links, among which zeros
    and base are. Their prior has zero mean; each moves the tip alike, and together they move its
    mean over the stretch as a restart does (`offset_sd_mm`, per axis). Observations count as many
    as are independent, by their autocorrelation, and half of that where they stand in a row. Poses
    at one place, by the SDs in training if known, tell that place's error. EstimatorError: fewer
    than 10 measured states, all at one place, offsets predict parts left out worse than none do
    (`or_none`: then there are none), or not clearly better from fewer than 12 independent ones.
    """
    floats("residuals_mm", residuals_mm, len(states), 3)
    if len(states) < FEWEST:
        raise EstimatorError(
            f"re-zeroing needs at least {FEWEST} measured states, got {len(states)}"
        )
    independent = _independent(residuals_mm)
    apart = independent > _APART * len(states)
    share = independent / len(states) * (1.0 if apart else _IN_A_ROW)
    needed = _APART_SPREAD if apart else _MIN_SPREAD
    if spread_sd is not None and len(spread_sd):
        moved = schema.read(states, schema.joints or schema.position).std(axis=0)
        wide = moved / np.maximum(spread_sd, 1e-9)
        if (spread := float(np.sqrt((wide**2).mean()))) < needed:
            raise EstimatorError(
                f"the joints of the {len(states)} measured states spread over {spread:.0%} of what "
                f"they did in training, {needed:.0%} are needed: {_CURE}"
            )
    design, scale = offset_design(schema, states, offset_sd_mm)
    held_out = _left_of_parts(design, residuals_mm, share)
    left, most = _left_share(residuals_mm, held_out)
    needless = left >= most
    if needless and not or_none:
        rms = np.sqrt([(one**2).sum(axis=1).mean() for one in (held_out, residuals_mm)])
        raise EstimatorError(
            f"re-zeroing would do harm: of each tenth of the {len(states)} measured states the "
            f"offsets of the others leave {rms[0]:.2f} mm RMS, none leave {rms[1]:.2f}: {_CURE}"
        )
    if not needless and independent < _MIN_INDEPENDENT and not apart and left > _CONVINCING:
        raise EstimatorError(
            f"the {len(states)} measured states tell as much of the zeros as {independent:.1f} "
            f"independent ones, their errors being alike, {_MIN_INDEPENDENT:g} are needed: {_CURE}"
        )
    found, scatter = _regression(design, residuals_mm, share)
    if needless:
        found, held_out = np.zeros_like(found), residuals_mm
    within = np.einsum("nij,jk,nlk->il", design, scatter, design) / len(design)
    return Zeroing(
        errors=scale * found,
        spread=scale[:, None] * scatter * scale,
        readings=schema.reading_matrix(schema.joints),
        chain=schema.chain,
        mean_mm=(design @ found).mean(axis=0),
        covariance=within,
        held_out_mm=held_out,
    )


def _left_of_parts(design: Floats, residuals: Floats, share: float) -> Floats:
    """What the offsets of all other parts leave of each, (n, 3)."""
    rows, out = np.arange(len(residuals)), residuals.copy()
    for part in np.array_split(rows, _PARTS):
        others = np.setdiff1d(rows, part)
        found, _ = _regression(design[others], residuals[others], share)
        out[part] -= design[part] @ found
    return out


def _left_share(residuals: Floats, held_out: Floats) -> tuple[float, float]:
    """Share of the squares that is left of parts left out, and what chance makes of no offsets."""
    count, before, after = len(residuals), 0.0, 0.0
    for part in np.array_split(np.arange(count), _PARTS):
        without, left = (np.linalg.norm(one[part], axis=1) for one in (residuals, held_out))
        far = 3.0 * np.median(without)  # single false detections must not decide
        before += float(np.minimum(without, far) @ np.minimum(without, far))
        after += float(np.minimum(left, far) @ np.minimum(left, far))
    return after / max(before, 1e-12), 1.0 + _CHANCE / count


def _independent(residuals: Floats) -> float:
    """Of how many independent observations (n, 3) know as much: n / (1 + 2 sum of correlations).

    Errors of neighbours are alike, for hysteresis lasts until the robot turns back.
    """
    count, residuals = len(residuals), residuals - residuals.mean(axis=0)
    total, power = 1.0, max(float((residuals**2).sum()), 1e-12)
    for lag in range(1, count // 2):
        correlation = float((residuals[lag:] * residuals[:-lag]).sum()) / power
        if correlation < 1.0 / np.sqrt(count):  # as chance makes it
            break
        total += 2.0 * correlation
    return count / total


def offset_design(
    schema: StateSchema, states: Floats, offset_sd_mm: float
) -> tuple[Floats, Floats]:
    """Columns (n, 3, p) in mm of unknowns whose SD is 1, and what these are counted in (p,).

    Each moves the tip alike, RMS over the states, and the mean over them is off by that SD per
    axis.
    """
    columns, reach = np.tile(np.eye(3), (len(states), 1, 1)), np.ones(3)
    if (chain := schema.chain) is not None:
        columns = link_jacobian(chain, schema.joint_positions(states))[:, :3]
        reach = np.sqrt((columns**2).sum(axis=1).mean(axis=0))
        least = np.where(np.resize(TURNS, reach.shape), _LEAST_LEVER_MM, 0.0)
        reach = np.maximum(reach, least)
    size = float(np.clip(offset_sd_mm, *_OFFSET_LIMITS_MM))
    means = float(((columns / reach).mean(axis=0) ** 2).sum())
    scale = size * np.sqrt(3.0 / means) / reach
    return columns * scale, scale


def _levers(chain: SerialChain, motion: Floats) -> Floats:
    """Of joints (k,) whose motion of the tip per unit is that; not of none where the tip rests."""
    slides = [joint.prismatic for joint in chain.joints]
    return np.where(slides, 1.0, np.maximum(motion, _LEAST_LEVER_MM))


def _regression(design: Floats, residuals: Floats, share: float) -> tuple[Floats, Floats]:
    """Unknowns and their covariance; every observation counts as that share of one."""
    left, known = residuals, {"links": np.ones(design.shape[2])}
    for _ in range(5):
        size = np.maximum(np.linalg.norm(left, axis=1), 1e-12)
        scale = max(float(np.median(size)) / 1.54, _MIN_SCALE_MM)  # of a 3-D normal, per axis
        weights = Huber(HUBER_SIGMAS * scale).weights(size) * (share / scale**2)
        fit = fit_blocks(residuals, {"links": design}, weights[:, None, None] * np.eye(3), known)
        left = fit.residuals
    return fit.values["links"], fit.covariances["links"]


_MEMORY_MM = 200.0  # of the joints' motion, at their levers, in which hysteresis is forgotten
_HOLD_S = 0.02  # the offset at the tip is computed anew after this time: at 1 kHz it hardly changes
_SHARE = 0.85  # of the stated variance, what offsets of joints and base can explain
_TRUSTED, _KEPT = 5.0, 0.97  # innovations that the stated size counts as; kept of them at each
_LARGEST = 9.0  # of a squared innovation per axis: a single false detection must not decide


class OffsetFollower:
    """Offsets (joints, if known, and base) that fade with motion, corrected by every true pose.

    Before the first one, and when all has faded, they are as uncertain as the model states; every
    true pose makes them less so, and the stated covariance with them. Its level follows the
    innovations: how large they are in comparison with what was expected. The drift monitor takes
    them as well, with the covariance less what a restart has in it.
    """

    def __init__(self, schema: StateSchema, restarts_mm: float = 0.0) -> None:
        """Learnt with offsets of SD `restarts_mm` per axis in the stated covariance, if any."""
        self.monitor = DriftMonitor()
        self._schema, self._restarts_mm = schema, restarts_mm
        self.forget()

    def forget(self) -> None:
        """The robot was started again: its offsets are others."""
        self._begun = False
        self._mean: Floats = np.zeros(0)
        self._spread: Floats = np.zeros((0, 0))
        self._time_s = self._held_s = np.nan
        self._surprise, self._expected = _TRUSTED, _TRUSTED

    def corrected(self, correction: Correction, state: Floats, time_s: float) -> Correction:
        """A model's correction with the offset at a state (features,)."""
        if not self._begun:
            return correction
        if not 0 <= time_s - self._held_s < _HOLD_S:
            self._fade(state, time_s)
            design = self._design(state)
            self._held_mm, self._held_mm2 = design @ self._mean, design @ self._spread @ design.T
            self._held_s = time_s
        covariance = self._held_mm2 + (1.0 - _SHARE) * correction.covariance
        level = self._surprise / self._expected
        error = correction.error_mm + self._held_mm
        return replace(correction, error_mm=error, covariance=level * covariance)

    def add(
        self,
        correction: Correction,
        state: Floats,
        time_s: float,
        true_mm: Floats,
        covariance: Floats,
    ) -> None:
        """Take the true position (3,) at a state that the model corrected so."""
        if not self._begun:
            self._begin(correction, state, time_s)
        self._fade(state, time_s)
        design, self._held_s = self._design(state), np.nan
        reported = self._schema.position_mm(state)
        innovation = true_mm - reported - correction.error_mm - design @ self._mean
        across = self._spread @ design.T
        stated = design @ across + (1.0 - _SHARE) * correction.covariance + covariance
        settled = without_restarts(correction.covariance, self._restarts_mm)
        self.monitor.add(innovation, design @ across + settled + covariance)
        squared = float(innovation @ np.linalg.solve(stated, innovation)) / 3.0
        fresh = (1.0 - _KEPT) * _TRUSTED
        self._surprise = _KEPT * self._surprise + fresh + min(squared, _LARGEST)
        self._expected = _KEPT * self._expected + fresh + 1.0
        gain = np.linalg.solve(stated, across.T).T
        self._mean = self._mean + gain @ innovation
        self._spread = self._spread - gain @ across.T

    def _begin(self, correction: Correction, state: Floats, time_s: float) -> None:
        """Offsets of one size each, at the tip as uncertain as the model says of it."""
        self._lever = np.zeros(0)
        if (chain := self._schema.chain) is not None:
            jacobian = chain.jacobian(self._schema.joint_positions(state))[:3]
            self._lever = _levers(chain, np.linalg.norm(jacobian, axis=0))
        design = self._design(state)
        stated = float(np.trace(correction.covariance))
        self._prior = _SHARE * stated / float((design**2).sum()) * np.eye(design.shape[1])
        self._mean, self._spread = np.zeros(len(self._prior)), self._prior
        self._at, self._time_s, self._begun = self._place(state), time_s, True

    def _fade(self, state: Floats, time_s: float) -> None:
        """Bring the offsets to a state; one earlier than the last changes nothing."""
        if time_s < self._time_s:
            return
        place = self._place(state)
        kept = float(np.exp(-np.abs(place - self._at).sum() / _MEMORY_MM))
        self._mean = kept * self._mean
        self._spread = kept**2 * self._spread + (1.0 - kept**2) * self._prior
        self._at, self._time_s = place, time_s

    def _place(self, state: Floats) -> Floats:
        """Joints in mm at their levers, or the position."""
        if self._schema.chain is None:
            return self._schema.position_mm(state)
        return self._schema.joint_positions(state) * self._lever

    def _design(self, state: Floats) -> Floats:
        """Motion (3, offsets) of the tip by an offset of 1 mm of each joint and of the base."""
        chain = self._schema.chain
        if chain is None:
            return np.eye(3)
        jacobian = chain.jacobian(self._schema.joint_positions(state))[:3]
        return np.concatenate([jacobian / self._lever, np.eye(3)], axis=1)


_LEAST_SHARE = 0.1


def without_restarts(covariance: Floats, restarts_mm: float) -> Floats:
    """Stated covariances (..., 3, 3) less the share of offsets, of an SD per axis, in them.

    A new recording's offsets are followed or taken away, and the rest is what cables do.
    """
    share = 1.0 - 3.0 * restarts_mm**2 / np.trace(covariance, axis1=-2, axis2=-1)
    return np.asarray(np.clip(share, _LEAST_SHARE, 1.0)[..., None, None] * covariance)


@dataclass
class DriftMonitor:
    """Detects changed cables: measured residuals that no longer fit the stated covariance.

    The squared Mahalanobis length of a residual per axis is 1 on average if they fit. Its
    exponential average is compared with a limit.
    """

    # of the average, beyond which retraining is due; 2 means residuals 1.4 times as large as
    # stated.
    limit: float = 2.0
    memory: float = 500.0  # labels over which to average
    ratio: float = 1.0
    count: int = 0

    def add(self, residual_mm: Floats, covariance: Floats) -> None:
        """Add one measured residual and its stated covariance."""
        squared = float(residual_mm @ np.linalg.solve(covariance, residual_mm)) / 3.0
        self.count += 1
        share = max(1.0 / self.count, 1.0 / self.memory)
        self.ratio += share * (min(squared, 50.0) - self.ratio)

    @property
    def due(self) -> bool:
        """Whether retraining is due."""
        return self.count >= min(100.0, self.memory) and self.ratio > self.limit

    def sentence(self) -> str:
        """For people."""
        size = self.ratio**0.5
        if self.count < 100:
            return f"drift: only {self.count} measured states, too few to judge"
        if self.due:
            return (
                f"drift: residuals are {size:.2f} times as large as promised: "
                "the cables have changed, train again"
            )
        return f"drift: none, residuals are {size:.2f} times as large as promised"

"""Which few parameters of the rig explain what a recording shows: hypotheses compete.

All residuals of all ball-views are fitted again for every hypothesis, robustly, with the pose of
every instant eliminated (Schur complement; Triggs et al. 2000, section 6). The best hypothesis is
the one with the largest gain in chi-square over the null, less what its parameters cost (Schwarz
1978); what gains nearly as much is a rival. What it leaves is explained further.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import erf

from measure.arrays import Floats
from measure.checking.causes import NAMED_SIGMAS, WRONG_SIGMAS, Word
from measure.checking.evidence import ASIDE, EDGE, Evidence, Linear
from measure.checking.hypotheses import (
    LARGEST,
    MIDWAY,
    WHOLE,
    Hypothesis,
    hypotheses,
    of_camera,
    wandering,
)  # fmt: skip
from measure.estimation.least_squares import summed
from measure.estimation.losses import Huber
from measure.geometry import RigidTransform, chi_square_quantile
from measure.geometry.covariance import symmetric_inverse

_LOSS = Huber(3.0)
_BIAS_SHARE, _COMMON_SHARE = 0.5, 1.5
"""Of a view's systematic error, what it errs by in all pictures alike; and what all outlines, and
all places, have in common (blur, gloss, codecs)."""
_WEAK_SIGMAS = 4.0
_BOUNDED = (Word.RADIUS, Word.SCALE)
"""Causes whose standard deviation bounds a bias, and is no scatter: less of it tells."""
_RIVAL_SHARE, _RIVAL_GAIN, _RIVAL_LEFT = 0.1, 16.0, 0.5
"""What gains less than the best by no more than this share, or this much, is as good if it is
simpler; and what leaves less than this, or than twice what the best leaves, is a rival."""
_RARE_PRICE, _GAP_SHARE = 15.0, 0.25
"""Of principal points, in chi-square: cameras are touched far more often. So much less costs a
clock that steps where its stamps have a gap, and so much less it may gain: while the body turns,
where it was a tenth of a second later is known badly."""
_BLOCKS, _ITERATIONS, _REFINED = 8, 8, 10
_MIN_INSTANTS, _MIN_PART = 4, 3
"""Least number of instants; and before and after the one at which something changes."""
_MOST_CAUSES = 3
_WORST_SHARE, _WORST_SIGMAS, _CHANCE_SHARE = 0.5, 30.0, 0.1
"""Of what is left, from which one camera is named; a view's most; views that may stray."""
_MAX_SPLITS = 40
_WHOLE = 0.2  # By which a mistake that holds or does not may seem to hold by more, or less, than 1


class Amount(NamedTuple):
    """The surest of the amounts, one per parameter, that a hypothesis is off by."""

    what: str  # "turn", "shift" or "roll" of a moved camera; "rate" of what drifts; else empty
    size: float
    sd: float  # along itself

    @property
    def deviations(self) -> float:
        """By how many of its standard deviations it is off."""
        return self.size / max(self.sd, 1e-30)


@dataclass(frozen=True, eq=False)
class Fit:
    """Hypotheses, fitted together."""

    hypotheses: tuple[Hypothesis, ...]
    values: Floats  # (q,) their parameters, one after the other
    common: Floats  # (m,) and what all pictures err by alike, in px: of outlines, and of places (2)
    poses: RigidTransform
    cost: float  # the robust sum of squares
    left: float  # its mean, in stated variances; one view counts up to so much
    covariance: Floats  # (q, q) by noise, constant biases, and between parts of the recording
    freedom: int
    amount: Amount  # what is off with the last hypothesis

    def last(self) -> tuple[Floats, Floats]:
        """Parameters (r,) of the last hypothesis, and their covariance."""
        count = self.hypotheses[-1].basis.shape[1]
        return self.values[-count:], self.covariance[-count:, -count:]

    @property
    def plausible(self) -> bool:
        """Whether the last hypothesis is off by what can be."""
        values, covariance = self.last()
        if self.hypotheses[-1].word in WHOLE:
            return abs(values[0] - 1) < max(NAMED_SIGMAS * np.sqrt(covariance[0, 0]), _WHOLE)
        most = LARGEST.get(self.hypotheses[-1].word, np.inf)
        return bool(np.linalg.norm(values) < most)

    @property
    def significance(self) -> float:
        """Squared Mahalanobis distance of the last hypothesis from nothing."""
        values, covariance = self.last()
        return float(values @ symmetric_inverse(covariance) @ values)


class Explanation(NamedTuple):
    """A hypothesis that was chosen."""

    fit: Fit  # beside those chosen before
    wrong: bool  # beyond doubt
    explains: float  # share of what was left before
    rivals: tuple[Fit, ...]

    @property
    def hypothesis(self) -> Hypothesis:
        """What it is."""
        return self.fit.hypotheses[-1]


def explain(evidence: Evidence) -> tuple[list[Explanation], float, Fit | None]:
    """The hypotheses that explain the evidence, the most important first.

    Behind them the mean square of the residuals in their stated variances, 1 or less where all is
    well; and the fit with all of them.
    """
    found: list[Explanation] = []
    if len(evidence.times_s) < _MIN_INSTANTS or len(np.unique(evidence.views)) < 2:
        return found, 0.0, None
    here = fitted(evidence, ())
    misfit = here.left
    taken: set[tuple[Word, str]] = set()
    while len(found) < _MOST_CAUSES:
        best = _best(evidence, here, taken)
        if best is None or (found and not best.wrong):  # Beside another the slight may be chance
            break
        found.append(best)
        here = best.fit
        if best.hypothesis.word is not Word.MOVED_AT:  # which may be more than once
            taken.add((best.hypothesis.word, best.hypothesis.of))
    return found, misfit, here


def _best(evidence: Evidence, here: Fit, taken: set[tuple[Word, str]]) -> Explanation | None:
    screened = [(score, h) for score, h in _screened(evidence, here) if (h.word, h.of) not in taken]
    best_of: dict[tuple[Word, str, bool, int], tuple[float, Hypothesis]] = {}
    for score, hypothesis in screened:
        key = (hypothesis.word, hypothesis.of, hypothesis.since is None, hypothesis.basis.shape[1])
        if score > best_of.get(key, (0.0, hypothesis))[0]:
            best_of[key] = score, hypothesis
    ranked = sorted(best_of.values(), key=lambda pair: -pair[0])[:_REFINED]
    fits = [fitted(evidence, (*here.hypotheses, h), here) for _, h in ranked]
    fits = [f for f in fits if f.plausible and (_at_gap(evidence, f) or _shows(f, _WEAK_SIGMAS))]
    if not fits:
        return None
    noise = max(1.0, min(fit.left for fit in fits))
    net = [(here.cost - fit.cost) / noise - _price(fit.hypotheses[-1], evidence) for fit in fits]
    alike = [f for f, gain in zip(fits, net, strict=True) if gain >= _enough(evidence, f, max(net))]
    alike.sort(key=lambda fit: (_price(fit.hypotheses[-1], evidence), fit.cost))
    best, *others = alike
    gain = here.cost - best.cost
    price = max(_price(best.hypotheses[-1], evidence), _RARE_PRICE * _at_gap(evidence, best))
    if gain / noise < price:
        return None
    own = {(best.hypotheses[-1].word, best.hypotheses[-1].of)}
    own.add((MIDWAY.get(best.hypotheses[-1].word, Word.UNKNOWN), best.hypotheses[-1].of))
    rivals = []
    for fit in () if best.hypotheses[-1].word in WHOLE else others:
        name = fit.hypotheses[-1].word, fit.hypotheses[-1].of
        if name not in own and fit.left < max(2 * best.left, _RIVAL_LEFT):
            own.add(name)
            rivals.append(fit)
    left = max(here.cost - best.freedom, gain)
    wrong = _at_gap(evidence, best) or _shows(best, WRONG_SIGMAS)
    return Explanation(best, wrong, gain / max(left, 1e-9), tuple(rivals))


def wanders_px(evidence: Evidence, fit: Fit, of: str) -> float:
    """By how many px RMS a camera's picture wanders, if this explains more than lasting causes.

    Else, and where `of` is no camera, 0.
    """
    names = [camera.name for camera in evidence.cameras]
    if of not in names:
        return 0.0
    index = names.index(of)
    others = tuple(one for one in fit.hypotheses if one.of != of)
    free = fitted(evidence, (*others, wandering(evidence, index)))
    noise = max(1.0, free.left)
    cost, instead = (
        each.cost / noise + sum(_price(one, evidence) for one in each.hypotheses)
        for each in (fit, free)
    )
    turns = free.last()[0].reshape(-1, 2)
    size_px = evidence.cameras[index].intrinsics.focal_px * float(np.std(turns, axis=0).max())
    return size_px if instead < cost else 0.0


def _shows(fit: Fit, sigmas: float) -> bool:
    """Whether the last hypothesis is that far from nothing: as a whole, and in what it states."""
    last = fit.hypotheses[-1]
    whole = NAMED_SIGMAS if last.word in _BOUNDED and sigmas < WRONG_SIGMAS else sigmas
    chance = chi_square_quantile(float(erf(whole / np.sqrt(2))), last.basis.shape[1])
    least = WRONG_SIGMAS if sigmas >= WRONG_SIGMAS else NAMED_SIGMAS
    return fit.significance > chance and fit.amount.deviations > least


def _enough(evidence: Evidence, fit: Fit, most: float) -> float:
    """The gain in chi-square, less its price, from which it explains as much as the best."""
    share = _GAP_SHARE if _at_gap(evidence, fit) else _RIVAL_SHARE
    return most - max(_RIVAL_GAIN, share * most)


def _at_gap(evidence: Evidence, fit: Fit) -> bool:
    """Whether it is a clock that steps by about as much as its stamps do there."""
    last = fit.hypotheses[-1]
    step = last.word is Word.CLOCK_STEP
    gap_s = evidence.gap_s(last.of, last.since or 0) if step else 0.0
    return abs(fit.last()[0][0] + gap_s) < gap_s / 2


def _price(one: Hypothesis, evidence: Evidence) -> float:
    """Of its parameters, in chi-square (Bayesian information criterion)."""
    rare = _RARE_PRICE if one.word is Word.POINT else 0.0
    if one.word is Word.CLOCK_STEP and evidence.gap_s(one.of, one.since or 0):
        rare = -_RARE_PRICE
    count = one.basis.shape[1] + (one.since is not None)
    return count * float(np.log(3 * len(evidence))) + rare


def _screened(evidence: Evidence, here: Fit) -> Iterator[tuple[float, Hypothesis]]:
    """Every hypothesis with what it is about to gain, its price taken off; the likely ones only."""
    system = _system(evidence, here)
    total = system.from_instant(0)
    for hypothesis in hypotheses(evidence):
        if hypothesis.drifts:
            sums = system.of_profile(hypothesis.basis, hypothesis.profile(evidence.times_s))
        else:
            sums = system.of_part(hypothesis.basis, *total)
        yield _score(evidence, system, sums, hypothesis), hypothesis
    count = len(evidence.times_s)
    splits = range(_MIN_PART, count - _MIN_PART + 1)
    for since in splits[:: -(-max(len(splits), 1) // _MAX_SPLITS)]:
        part = system.from_instant(since)
        for index, camera in enumerate(evidence.cameras):
            for one in of_camera(evidence, index, camera.name):
                later = one._replace(word=MIDWAY[one.word], since=since)
                sums = system.of_part(one.basis, *part)
                yield _score(evidence, system, sums, later), later


class _System(NamedTuple):
    """Normal equations, instant by instant, the poses eliminated."""

    normal: Floats  # (k, p, p)
    right: Floats  # (k, p)
    nuisance: list[int]  # columns that are always free
    fixed: Floats  # (m, m) of the nuisance, over all instants

    def from_instant(self, since: int) -> tuple[Floats, Floats]:
        """Their sums from an instant on."""
        return self.normal[since:].sum(axis=0), self.right[since:].sum(axis=0)

    def of_part(self, basis: Floats, normal: Floats, right: Floats) -> _Sums:
        """Of a hypothesis that holds for a part of the instants."""
        by_basis = normal @ basis
        return _Sums(basis.T @ by_basis, by_basis[self.nuisance], basis.T @ right)

    def of_profile(self, basis: Floats, profile: Floats) -> _Sums:
        """Of one with so much of each parameter (k, q) at each instant."""
        by_basis = (self.normal @ basis) * profile[:, None, :]
        own = np.einsum("pi,kpj,ki->ij", basis, by_basis, profile, optimize=True)
        right = np.sum(self.right @ basis * profile, axis=0)
        return _Sums(own, by_basis[:, self.nuisance].sum(axis=0), right)


class _Sums(NamedTuple):
    """Normal equations of q parameters of a hypothesis, beside the nuisance."""

    own: Floats  # (q, q)
    cross: Floats  # (m, q)
    right: Floats  # (q,)


def _system(evidence: Evidence, here: Fit) -> _System:
    values = np.concatenate([here.values, here.common])
    linear = _linearised(evidence, here.poses, here.hypotheses, values)
    parts = _Normal.of(evidence, linear, linear.by_rig)
    normal, right = parts.normal, parts.right
    nuisance = _common(evidence)
    total = normal.sum(axis=0)
    fixed = total[np.ix_(nuisance, nuisance)] + _common_prior(evidence) * np.eye(len(nuisance))
    return _System(normal, right, nuisance, fixed)


def normal_equations(evidence: Evidence) -> tuple[Floats, Floats, Floats]:
    """Of all parameters of the rig by balls' centres, the poses eliminated.

    They are (p, p) and (p,); and (b, p) what biases add to the latter.
    """
    here = np.zeros((1, evidence.size))
    evidence = replace(evidence, whitening=evidence.whitening * np.array([[1.0], [1.0], [0.0]]))
    linear = evidence.linearised(evidence.poses, here, np.zeros(len(evidence), np.int64))
    parts = _Normal.of(evidence, linear, linear.by_rig)
    return parts.normal.sum(axis=0), parts.right.sum(axis=0), _biased(evidence, parts.own)


def _common(evidence: Evidence) -> list[int]:
    """The columns of what all pictures err by alike."""
    return [evidence.shared(what) for what in (EDGE, ASIDE, ASIDE + 1)]


def _common_prior(evidence: Evidence) -> float:
    return 1 / (_COMMON_SHARE * evidence.systematic_px) ** 2


def _score(evidence: Evidence, system: _System, sums: _Sums, hypothesis: Hypothesis) -> float:
    """The gain in chi-square near the state, less the price."""
    own = sums.own - sums.cross.T @ np.linalg.solve(system.fixed, sums.cross)
    gain = float(sums.right @ symmetric_inverse(own) @ sums.right)
    return gain - _price(hypothesis, evidence)


class _Normal(NamedTuple):
    """Normal equations of q parameters by instant, the poses eliminated."""

    normal: Floats  # (k, q, q)
    right: Floats  # (k, q)
    own: Floats  # (n, 3, q) the right side's derivative by the residuals
    steps: Floats  # (k, 6) of the poses alone
    adapts: Floats  # (k, 6, q) and how these follow the parameters
    cost: float
    capped: float  # the same, where what is not the body at all counts no more than a view can err

    @classmethod
    def of(cls, evidence: Evidence, linear: Linear, by_others: Floats) -> _Normal:
        residuals, by_pose, _ = linear
        length = np.linalg.norm(residuals, axis=1)
        weight = _LOSS.weights(length)
        weighted = weight[:, None, None] * np.swapaxes(by_pose, 1, 2)
        count = len(evidence.times_s)
        V, W, h = (
            summed(weighted @ by, evidence.instants, count)
            for by in (by_pose, by_others, residuals[:, :, None])
        )
        inverse = _inverses(V)
        adapts = inverse @ W
        own = weight[:, None, None] * (by_others - by_pose @ adapts[evidence.instants])
        normal = summed(np.swapaxes(own, 1, 2) @ by_others, evidence.instants, count)
        right = summed(np.einsum("niq,ni->nq", own, residuals), evidence.instants, count)
        steps = (inverse @ h)[:, :, 0]
        cost, capped = _LOSS.cost(length), _LOSS.cost(np.minimum(length, _WORST_SIGMAS))
        return cls(normal, right, own, steps, adapts, cost, capped)


def _inverses(matrices: Floats) -> Floats:
    """Of symmetric matrices (k, n, n) that may be singular."""
    scale = np.sqrt(np.maximum(np.einsum("kii->ki", matrices), 1e-12))
    unit = matrices / (scale[:, :, None] * scale[:, None, :])
    return np.asarray(
        np.linalg.pinv(unit, rcond=1e-9, hermitian=True) / (scale[:, :, None] * scale[:, None, :])
    )


def broadly_left(evidence: Evidence, fit: Fit) -> tuple[float, str | None]:
    """`Fit.left` without the worst views, and the camera that causes most of `Fit.left`, if any."""
    values = np.concatenate([fit.values, fit.common])
    residuals = _linearised(evidence, fit.poses, fit.hypotheses, values).residuals
    lengths = np.minimum(np.linalg.norm(residuals, axis=1), _WORST_SIGMAS)
    usual = np.sort(lengths)[: round((1 - _CHANCE_SHARE) * len(lengths))]
    shares = np.bincount(evidence.views, lengths**2, len(evidence.cameras))
    worst = int(np.argmax(shares))
    name = evidence.cameras[worst].name if shares[worst] > _WORST_SHARE * shares.sum() else None
    return _LOSS.cost(usual) / max(fit.freedom, 1), name


def _linearised(
    evidence: Evidence, poses: RigidTransform, some: Sequence[Hypothesis], values: Floats
) -> Linear:
    """The evidence about hypotheses with values (q + m,), behind which is what is common."""
    at, rigs = 0, np.zeros((len(evidence.times_s), evidence.size))
    common = _common(evidence)
    rigs[:, common] = values[-len(common) :]
    for hypothesis in some:
        count = hypothesis.basis.shape[1]
        held = hypothesis.profile(evidence.times_s) * values[at : at + count]
        rigs += held @ hypothesis.basis.T
        at += count
    kinds, states = np.unique(rigs, axis=0, return_inverse=True)
    return evidence.linearised(poses, kinds, states.reshape(-1)[evidence.instants])


def fitted(evidence: Evidence, some: Sequence[Hypothesis], start: Fit | None = None) -> Fit:
    """Fit hypotheses together with the poses, robustly, by Gauss-Newton."""
    count = sum(h.basis.shape[1] for h in some)
    common = _common(evidence)
    values = np.zeros(count + len(common))
    poses = evidence.poses
    if start is not None:
        poses = start.poses
        values[: len(start.values)], values[count:] = start.values, start.common
    prior = np.diag(np.repeat([0.0, _common_prior(evidence)], [count, len(common)]))
    best: tuple[float, Floats, RigidTransform, _Normal, Floats] | None = None
    for _ in range(_ITERATIONS):
        linear = _linearised(evidence, poses, some, values)
        columns = [
            (linear.by_rig @ h.basis) * h.profile(evidence.times_s)[evidence.instants, None]
            for h in some
        ]
        columns.append(linear.by_rig[:, :, common])
        parts = _Normal.of(evidence, linear, np.concatenate(columns, axis=2))
        cost = parts.cost + float(values @ prior @ values)
        normal = parts.normal.sum(axis=0) + prior
        settled = best is not None and best[0] - cost < 1e-3 * abs(cost)
        if best is None or cost < best[0]:
            best = cost, values, poses, parts, normal
        if settled:
            break
        step = symmetric_inverse(normal) @ (parts.right.sum(axis=0) - prior @ values)
        values = values + step
        poses = poses.perturb(parts.steps - parts.adapts @ step)
    assert best is not None
    cost, values, poses, parts, normal = best
    freedom = 3 * len(evidence) - 6 * len(evidence.times_s) - count
    noise = max(1.0, cost / max(freedom, 1))
    covariance = _covariance(evidence, parts, normal, noise)[:count, :count]
    left = parts.capped / max(freedom, 1)
    values, aside = values[:count], values[count:]
    amount = _amount(evidence, poses, some[-1:], values, covariance)
    return Fit(tuple(some), values, aside, poses, cost, left, covariance, freedom, amount)


def _amount(
    evidence: Evidence,
    poses: RigidTransform,
    last: Sequence[Hypothesis],
    values: Floats,
    covariance: Floats,
) -> Amount:
    """The part that is off by most standard deviations; of no hypothesis nothing."""
    surest = Amount("", 0.0, 0.0)
    for hypothesis in last:
        for what, by in _parts(evidence, poses, hypothesis).items():
            part = by @ values[-by.shape[1] :]
            size = float(np.linalg.norm(part))
            axis = part @ by / max(size, 1e-30)
            spread = float(axis @ covariance[-by.shape[1] :, -by.shape[1] :] @ axis)
            amount = Amount(what, size, float(np.sqrt(max(spread, 0.0))))
            surest = max(surest, amount, key=lambda one: one.deviations)
    return surest


def _parts(evidence: Evidence, poses: RigidTransform, one: Hypothesis) -> dict[str, Floats]:
    """The amounts of a hypothesis: its parts (s, q) by its parameters."""
    eye = np.eye(one.basis.shape[1])
    if one.drifts:
        return {"rate": eye[len(eye) // 2 :]}
    if one.word is not Word.MOVED or len(eye) < 6:
        return {"": eye}
    index = [camera.name for camera in evidence.cameras].index(one.of)
    own = np.flatnonzero(evidence.views == index)
    here = evidence.linearised(poses, np.zeros((1, evidence.size)), np.zeros(len(evidence), int))
    seen = np.linalg.solve(evidence.whitening[own], here.by_rig[own] @ one.basis)[:, :2]
    turn = seen.mean(axis=0) / evidence.cameras[index].intrinsics.focal_px
    return {"turn": turn, "shift": eye[:3], "roll": eye[5:]}


def _covariance(evidence: Evidence, parts: _Normal, normal: Floats, noise: float) -> Floats:
    """Of noise, of constant biases, and between blocks of the recording (jackknife)."""
    inverse = symmetric_inverse(normal)
    right = parts.right.sum(axis=0)
    blocks = np.array_split(np.arange(len(parts.right)), min(_BLOCKS, len(parts.right)))
    spread = np.array(
        [
            symmetric_inverse(normal - parts.normal[block].sum(axis=0))
            @ (right - parts.right[block].sum(axis=0))
            - inverse @ right
            for block in blocks
        ]
    )
    jackknife = (len(blocks) - 1) / len(blocks) * spread.T @ spread
    biased = _biased(evidence, parts.own) @ inverse
    return np.asarray(noise * inverse + jackknife + biased.T @ biased)


def _biased(evidence: Evidence, own: Floats) -> Floats:
    """What constant biases of each ball in each camera add to the right side (b, q)."""
    bias = np.zeros((len(evidence.cameras) * len(evidence.body.balls), 3, own.shape[2]))
    bias_px = _BIAS_SHARE * evidence.systematic_px
    sizes = 2 * bias_px * np.exp(-evidence.seen[:, 2])
    units = np.stack([np.full(len(evidence), bias_px)] * 2 + [sizes], axis=1)
    by_bias = np.swapaxes(evidence.whitening * units[:, None, :], 1, 2) @ own
    np.add.at(bias, evidence.views * len(evidence.body.balls) + evidence.balls, by_bias)
    return bias.reshape(-1, own.shape[2])

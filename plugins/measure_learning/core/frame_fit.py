"""Where a robot's base is, and a body on its tool: least squares, on numbers alone.

Every pose is world_from_base @ base_from_flange @ flange_from_body. Both rotations come in closed
form (Shah 2013, J. Mech. Robotics 5, 031007), both translations by linear least squares; then all
is fitted at once, with the clocks and the errors of the links. These are part of the answer, or
else only counted: what they may do to the frames is in the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Bools, Floats, rms_length
from measure.geometry import RigidTransform, chi_square_quantile, propagate
from measure.geometry.covariance import posterior_covariance, squared_mahalanobis, undetermined
from measure.limits import LEVER_MM, MAX_STEPS
from measure.metrology.poses import independent_count
from measure_learning.core.clock import MIN_KEPT_SHARE
from measure_learning.core.robot_model import FRAMES, LinearModel, RobotState, Sightings
from measure_learning.robots.links import LinkEffects, usual_sd

_OUTLIER_SDS = 6.0
_EXACT_S = 1e-7  # SD of a clock that is given
_UNKNOWN_MM, _UNKNOWN_RAD, _UNKNOWN_S = 1e3, 2.0, 1.0
"""SD of a shift, a turn and a clock that nothing shows: more than an arm, any turn, a search."""
OPEN_SHARE = 0.1
"""Of these, from which a direction counts as not determined: 100 mm and 11 deg are no answer."""
_ROUNDS = 3  # of leaving out poses that disagree
_DRAWS, _DRAWN, _STEPS = 50, 6, 2  # starts from a few stops, and steps from each
_LEAST_SINGULAR = 1e-2  # of shifts, over the largest: turns by 1 deg may be noise alone


@dataclass(frozen=True, eq=False)
class FrameFit(RobotState):
    """What is fitted, and how well it is known; links are zero where they are only counted."""

    link_sd: Floats = field(default_factory=lambda: np.zeros(0))
    """(links,) of the links before anything is fitted."""
    noise: float = 1.0  # variance of what is left, over what the poses state
    share: float = 1.0  # of the poses that are independent: slack and bending last for a while
    # (m, m) of the frames, the clocks and, if they are fitted, the links.
    covariance: Floats = field(default_factory=lambda: np.eye(0))
    # (12, links) how one SD of a link's error moves the frames.
    frames_by_links: Floats = field(default_factory=lambda: np.eye(0))
    kept: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) not left out
    # (m, m) of frames, clocks and links: inverse variances by the poses.
    normal: Floats = field(default_factory=lambda: np.eye(0))
    alone: FrameFit | None = None  # the frames without the links
    bent: FrameFit | None = None  # the frames with the links

    def residuals(self, seen: Sightings) -> Floats:
        """Measured minus modelled (n, 6), or (n, 3) where the flange's rotation is not known."""
        return LinearModel.of(self, seen).residuals

    def rms_mm(self, seen: Sightings) -> float:
        """Of the positions that are left, where the cameras measure: at the body's origin."""
        return rms_length(self.residuals(seen)[:, :3])

    def open_directions(self, seen: Sightings) -> Floats:
        """Directions (12, k) of both frames that nothing shows, in mm and rad."""
        known = precision(seen, self.link_sd)
        C = posterior_covariance(self.normal, known)[:FRAMES, :FRAMES]
        return undetermined(C, OPEN_SHARE * known[:FRAMES] ** -0.5)


def fit_frames(seen: Sightings, *, kinematics: bool) -> FrameFit:
    """The frames and clocks, with the links' errors fitted or only counted.

    Poses that disagree by six standard deviations are left out: `kept` has the others.
    """
    kept = best_stops(seen) if seen.apart else np.ones(len(seen.poses), dtype=bool)
    frames = _closed_form(seen.take(kept))
    for _ in range(_ROUNDS):
        some = seen.take(kept)
        start = FrameFit.nominal(some, *frames)
        fit = _with_links(replace(start, link_sd=usual_sd(seen.links)), some)
        fit = replace(fit, share=1.0 if seen.apart else _share(fit, some))
        good = agree(fit, seen, kept)
        if np.array_equal(good, kept):
            break
        kept, frames = good, (fit.world_from_base, fit.body_from_flange)
    seen = seen.take(kept)
    fit = _with_links(fit, seen)
    near = LinearModel.of(fit, seen)
    fit = replace(fit, kept=kept, normal=near.normal()[1] * (fit.share / fit.noise))
    plain = _without_links(fit, seen)
    if kinematics:
        plain = replace(fit, frames_by_links=plain.frames_by_links, alone=plain, bent=fit)
        return replace(plain, covariance=_covariance(near, fit, seen))
    return replace(plain, alone=plain, bent=fit)


def _share(fit: FrameFit, seen: Sightings) -> float:
    """Of the poses that are independent."""
    white = LinearModel.of(fit, seen).white
    counts = [independent_count(white[seen.recording == k]) for k in range(len(seen.shared))]
    return sum(counts) / len(white)


def agree(fit: FrameFit, seen: Sightings, kept: Bools) -> Bools:
    """Which poses (n,) are within six standard deviations, by the usual size of the kept ones.

    What the kept stops leave open of the frames and the links counts with the others: these are few
    and were not fitted.
    """
    near = LinearModel.of(fit, seen)
    size, covariances = near.residuals.shape[1], near.covariances
    squares = squared_mahalanobis(near.residuals, covariances)
    usual = float(np.median(squares[kept])) / chi_square_quantile(0.5, size)
    if seen.apart:
        usual = max(usual, fit.noise, 1.0)
        N = LinearModel.of(fit, seen.take(kept)).normal()[1]
        P = posterior_covariance(N / usual, precision(seen, fit.link_sd))
        squares = squared_mahalanobis(
            near.residuals, covariances + propagate(near.slopes, P) / usual
        )
    return np.asarray(squares <= _OUTLIER_SDS**2 * size / 3 * max(usual, 1e-12))


def best_stops(seen: Sightings) -> Bools:
    """The stops (n,) that base and tool bring together best, as many as must be kept.

    Least trimmed squares, by concentration from stops drawn at random (Rousseeuw and Van Driessen
    1999): a few stops of a false pose do not move it as they move a fit to all.
    """
    n = len(seen.poses)
    out = np.ones(n, dtype=bool)
    turns = seen.hand().rotation, seen.poses.world_from_body.rotation
    if n <= _DRAWN + 1 or (seen.chain and leave_one_open(*turns)):
        return out
    rng, count, least = np.random.default_rng(0), int(np.ceil(MIN_KEPT_SHARE * n)), np.inf
    for _ in range(_DRAWS):
        rows = rng.choice(n, _DRAWN, replace=False)
        for _ in range(_STEPS):
            miss = _misses_mm(seen, _closed_form(seen.take(rows)))
            rows = np.argsort(miss)[:count]
        if (sum_ := float(np.sum(miss[rows] ** 2))) < least:
            least, out = sum_, np.isin(np.arange(n), rows)
    return out


def _with_links(fit: FrameFit, seen: Sightings) -> FrameFit:
    """Everything at once; the links' standard deviations and the noise as well."""
    known = precision(seen, fit.link_sd)[: FRAMES + len(seen.shared)]
    found = LinkEffects(known, known, fit.link_sd, fit.noise)
    for step in range(MAX_STEPS):
        near = LinearModel.of(fit, seen)
        _, N, g = near.normal()
        squares = float(squared_mahalanobis(near.residuals, near.covariances).sum())
        found = found.solved((N, g, squares, near.residuals.size), known, fit.links, fit.share)
        fit = fit.moved(near.split(found.step))
        fit = replace(fit, link_sd=found.link_sd, noise=found.noise)
        if step > 1 and np.all(np.abs(found.step) < 0.01 * np.sqrt(np.diag(found.covariance))):
            break
    return fit


def _without_links(fit: FrameFit, seen: Sightings) -> FrameFit:
    """Frames and clocks alone, weighted by all that is left; its covariance counts the links."""
    free = FRAMES + len(seen.shared)
    fitted = replace(fit, links=np.zeros_like(fit.links))
    known = precision(seen, fit.link_sd)[:free]
    for _ in range(MAX_STEPS):
        near = LinearModel.of(fitted, seen)
        weighted, N, g = near.normal(_spread(near, fit))
        inverse = posterior_covariance(N[:free, :free], known)
        x = inverse @ g[:free]
        fitted = fitted.moved(near.split(x))
        if np.abs(x).max() < 1e-6:
            break
    by_links = (inverse @ N[:free])[:, free:] * fit.link_sd
    noise = _of_noise(
        inverse @ weighted[:, :free] @ near.by_pose, LinearModel.of(fit, seen), fit, seen
    )
    open_ = (inverse * known) @ inverse  # what only this holds is as uncertain as it says
    covariance = by_links @ by_links.T + noise + open_
    return replace(fitted, covariance=covariance, frames_by_links=by_links[:FRAMES])


def _spread(near: LinearModel, fit: FrameFit) -> Floats:
    """Covariance (m, m) of what is left: as seen, and as links of the usual size make it.

    Few residuals say little of it themselves: the frames are fitted to them.
    """
    n = len(near.residuals)
    links = near.blocks["links"] * fit.link_sd
    model = np.einsum("nak,nbk->ab", links, links) / n
    few = near.slopes.shape[2] ** 2 / n  # so many of the model's count beside n that are seen
    return np.asarray((near.residuals.T @ near.residuals + few * model) / (n + few))


def _covariance(near: LinearModel, fit: FrameFit, seen: Sightings) -> Floats:
    """Of everything, links fitted: by the noise, and by what the links' prior leaves open."""
    weighted, N, _ = near.normal()
    known = precision(seen, fit.link_sd)
    inverse = posterior_covariance(N * (fit.share / fit.noise), known)
    gains = inverse @ weighted @ near.by_pose * (fit.share / fit.noise)
    return np.asarray(_of_noise(gains, near, fit, seen) + (inverse * known) @ inverse)


def _of_noise(gains: Floats, near: LinearModel, fit: FrameFit, seen: Sightings) -> Floats:
    """Covariance of sums of the poses' errors, weighted by `gains` (n, m, 6).

    What is left beyond the noise that a run states (slack, gears, vibration) is alike for a while:
    it counts by its autocorrelation.
    """
    white = near.white
    total = np.zeros((gains.shape[1],) * 2)
    for index, shared in enumerate(seen.shared):
        rows = np.flatnonzero(seen.recording == index)
        own, poses = white[rows], seen.poses.take(rows)
        level = float(np.mean(own**2)) * len(rows) / independent_count(own)
        if seen.apart:
            level = fit.noise
        scatter = float(np.mean(np.diff(own, axis=0) ** 2) / 2)
        if shared is not None:
            total += shared.of_sum(gains[rows], poses, scatter)
            level = max(level - max(scatter, 1.0), 0.0)
        total += level * propagate(gains[rows], poses.covariances).sum(axis=0)
    return total


def precision(seen: Sightings, link_sd: Floats) -> Floats:
    """Inverse variances of all parameters beforehand."""
    return np.concatenate(list(priors(seen, link_sd).values()))


def priors(seen: Sightings, link_sd: Floats) -> dict[str, Floats]:
    """Inverse variances of every block beforehand: next to nothing is known, but of links."""
    frame = np.repeat([_UNKNOWN_MM, _UNKNOWN_RAD], 3) ** -2.0
    clocks = np.full(len(seen.shared), (_EXACT_S if seen.clocks_known else _UNKNOWN_S) ** -2.0)
    return {"frame": frame, "tool": frame, "delay": clocks, "links": link_sd**-2.0}


def _closed_form(seen: Sightings) -> tuple[RigidTransform, RigidTransform]:
    """world_from_base and body_from_flange: rotations first, then translations."""
    poses = seen.poses.world_from_body
    hand = seen.hand()
    if seen.chain:
        starts = [pair[:2] for pair in turn_starts(hand.rotation, poses.rotation)]
    else:  # R_pose p + t = A reported + b, linear in p, A and b
        unit = np.broadcast_to(np.eye(3), poses.rotation.shape)
        spread = np.einsum("nk,ij->nikj", hand.translation, np.eye(3)).reshape(-1, 3, 9)
        rows = np.concatenate([spread, unit, -poses.rotation], axis=2).reshape(-1, 15)
        flat = np.linalg.lstsq(rows, poses.translation.ravel())[0][:9]
        starts = [(nearest_rotation(flat), np.eye(3))]
    return min((_with_shifts(hand, poses, *turns) for turns in starts), key=lambda found: found[2])[
        :2
    ]


def _with_shifts(
    hand: RigidTransform, poses: RigidTransform, base: Floats, flange: Floats
) -> tuple[RigidTransform, RigidTransform, float]:
    """Both translations to rotations world_from_base and body_from_flange; what is left, mm."""
    turned = np.broadcast_to(np.eye(3), poses.rotation.shape)
    rows = np.concatenate([turned, -poses.rotation], axis=2).reshape(-1, 6)
    wanted = (poses.translation - hand.translation @ base.T).ravel()
    x = np.linalg.lstsq(rows, wanted, rcond=_LEAST_SINGULAR)[0]
    left = float(np.linalg.norm(wanted - rows @ x))
    return RigidTransform(base, x[:3]), RigidTransform(flange, x[3:]), left


def _misses_mm(seen: Sightings, frames: tuple[RigidTransform, RigidTransform]) -> Floats:
    """By how much frames miss the poses (n,), mm; turns count at a lever."""
    base, flange = frames
    poses, hand = seen.poses.world_from_body, base @ seen.hand()
    if seen.chain is None:
        point = np.broadcast_to(flange.translation, (len(seen.poses), 3))
        return np.linalg.norm(poses.apply(point) - hand.translation, axis=1)
    r = poses.difference(hand @ flange.inverse())
    return np.linalg.norm(r * np.repeat([1.0, LEVER_MM], 3), axis=1)


def quick_miss(seen: Sightings) -> float:
    """What the closed form leaves, mm RMS; turns count at a lever."""
    return rms_length(_misses_mm(seen, _closed_form(seen))[:, None])


def turns_agree(seen: Sightings) -> float:
    """1 where some base and flange bring all rotations together, less where none does."""
    K = turn_products(seen.hand().rotation, seen.poses.world_from_body.rotation)
    return float(np.linalg.norm(K, 2))


_TURN_STEPS = 12
_TOLERANCE_RAD = 0.02  # up to which solutions are as good
_STARTS = 24  # rotations that are tried where the closed form leaves one open
_ALIKE = 0.98  # ratio of two singular values, from which there are several solutions


def align_turns(hand: Floats, pose: Floats) -> tuple[Floats, Floats, float]:
    """Rotations world_from_base and body_from_flange, of base_from_flange and world_from_body.

    Those are (n, 3, 3); last the angle, rad RMS, by which they miss each other.
    """
    return min(turn_starts(hand, pose), key=lambda found: found[2])


def turn_starts(hand: Floats, pose: Floats) -> list[tuple[Floats, Floats, float]]:
    """What `align_turns` returns: once, or several that are as good, if the turns leave one open.

    So they do if all are about one axis, or if there are none.
    """
    K = turn_products(hand, pose)
    u, sizes, v = np.linalg.svd(K)
    pairs = [(nearest_rotation(u[:, 0]), nearest_rotation(v[0]))]
    if sizes[1] > _ALIKE * sizes[0]:
        turns = Rotation.random(_STARTS, rng=0).as_matrix()
        pairs += [(turn, np.eye(3)) for turn in turns]
    out = []
    for base, flange in pairs:
        for _ in range(_TURN_STEPS if len(pairs) > 1 else 0):
            flange = nearest_rotation(K.T @ base.T.ravel())
            base = nearest_rotation(K @ flange.T.ravel())
        agreed = float(base.T.ravel() @ K @ flange.T.ravel())
        out.append((base, flange, float(np.sqrt(max(0.0, 3 - agreed)))))
    best = min(found[2] for found in out)
    return [found for found in out if found[2] < best + _TOLERANCE_RAD]


def leave_one_open(hand: Floats, pose: Floats) -> bool:
    """Whether the turns are about one axis, or none, so that many rotations do as well."""
    sizes = np.linalg.svd(turn_products(hand, pose), compute_uv=False)
    return bool(sizes[1] > _ALIKE * sizes[0])


def turn_products(hand: Floats, pose: Floats) -> Floats:
    """With vec by columns, vec(R_base) = (R_hand x R_pose) vec(R_flange): their mean (9, 9)."""
    return np.asarray(np.einsum("nab,ncd->acbd", hand, pose).reshape(9, 9) / len(hand))


def nearest_rotation(columns: Floats) -> Floats:
    """Of a matrix (9,) by columns, of any size and sign."""
    matrix = columns.reshape(3, 3).T
    u, _, v = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(u @ v)

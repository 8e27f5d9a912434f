"""Where a robot's base is, and a body on its tool: least squares, on numbers alone.

Every pose is world_from_base @ base_from_flange @ flange_from_body. Both rotations come in closed
form (Shah 2013, J. Mech. Robotics 5, 031007), both translations by linear least squares; then all
is fitted at once, with the clocks and the errors of the links. These are part of the answer, or
else only counted: what they may do to the frames is in the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Bools, Floats, Ints, rms_length
from measure.geometry import RigidTransform, chi_square_quantile, propagate, skew
from measure.geometry.covariance import squared_mahalanobis
from measure.metrology.poses import PoseTable, SharedErrors, independent_count
from measure.robots import SerialChain
from measure.robots.chain import LinkEffects, link_jacobian, usual_sd, with_link_errors

FRAMES = 12
"""Parameters of both frames: world_from_base, then body_from_flange, each as `perturb` has them."""
_OUTLIER_SDS = 6.0
_STEPS = 12
_EXACT_S = 1e-7  # SD of a clock that is given
_UNKNOWN_RAD = 2.0  # SD of a turn that nothing shows


@dataclass(frozen=True, eq=False)
class Sightings:
    """Poses of all recordings, and what the robot reports at their instants."""

    poses: PoseTable  # n of them
    recording: Ints  # (n,) which of the recordings, from 0 on
    reported_mm: Floats  # (n, 3) the flange
    joints: Floats  # (n, joints) of the chain
    rates: Floats  # (n, joints) their change per second; without a chain (n, 3), of the flange
    chain: SerialChain | None
    shared: tuple[SharedErrors | None, ...]  # of each recording; errors are independent if None
    clocks_known: bool = False

    @property
    def links(self) -> int:
        """Number of links' errors."""
        return 6 * self.chain.size if self.chain else 0

    def take(self, rows: Ints | Bools) -> Sightings:
        """Some of them."""
        by_row = ("recording", "reported_mm", "joints", "rates")
        taken = {name: getattr(self, name)[rows] for name in by_row}
        return replace(self, poses=self.poses.take(rows), **taken)

    def flange(self, links: Floats, clocks_s: Floats) -> tuple[RigidTransform, Floats, Floats]:
        """base_from_flange (n), and its change by a second (n, 6) and by the links (n, 6, links).

        Without a chain it does not turn.
        """
        late = clocks_s[self.recording, None] * self.rates
        if self.chain is None:
            twist = np.concatenate([self.rates, np.zeros_like(self.rates)], axis=1)
            moved = RigidTransform(np.eye(3), self.reported_mm + late)
            return moved, twist, np.zeros((len(late), 6, 0))
        bent, q = with_link_errors(self.chain, links), self.joints + late
        pose = bent.pose(q)
        place = pose.translation + self.reported_mm - self.chain.tip_mm(self.joints)
        twist = np.einsum("nij,nj->ni", bent.jacobian(q), self.rates)
        return RigidTransform(pose.rotation, place), twist, link_jacobian(bent, q)


@dataclass(frozen=True, eq=False)
class FrameFit:
    """What is fitted, and how well it is known."""

    world_from_base: RigidTransform
    body_from_flange: RigidTransform
    clocks_s: Floats  # (recordings,) what is to be added to the offsets of the sightings
    links: Floats  # (links,) errors, mm and rad; zero where they are only counted
    link_sd: Floats  # (links,) of these before anything is fitted
    noise: float = 1.0  # variance of what is left, over what the poses state
    share: float = 1.0  # of the poses that are independent: slack and bending last for a while
    # (m, m) of the frames, the clocks and, if they are fitted, the links.
    covariance: Floats = field(default_factory=lambda: np.eye(0))
    # (12, links) how one SD of a link's error moves the frames.
    frames_by_links: Floats = field(default_factory=lambda: np.eye(0))

    def residuals(self, seen: Sightings) -> Floats:
        """Measured minus modelled (n, 6), or (n, 3) where the flange's rotation is not known."""
        return _Linear.of(self, seen).residuals

    def rms_mm(self, seen: Sightings) -> float:
        """Of the positions that are left, where the cameras measure: at the body's origin."""
        return rms_length(self.residuals(seen)[:, :3])


def fit_frames(seen: Sightings, *, kinematics: bool) -> FrameFit:
    """The frames and clocks, with the links' errors fitted or only counted.

    Poses that disagree by six standard deviations are left out.
    """
    count, links = len(seen.shared), seen.links
    fit = FrameFit(*_closed_form(seen), np.zeros(count), np.zeros(links), usual_sd(links))
    fit = _with_links(fit, seen)
    near = _Linear.of(fit, seen)
    squares, size = squared_mahalanobis(near.residuals, near.covariances), near.residuals.shape[1]
    usual = np.median(squares) / chi_square_quantile(0.5, size)
    seen = seen.take(np.asarray(squares <= _OUTLIER_SDS**2 * size / 3 * usual))
    white = _Linear.of(fit, seen).white
    counts = [independent_count(white[seen.recording == k]) for k in range(count)]
    fit = _with_links(replace(fit, share=sum(counts) / len(white)), seen)
    plain = _without_links(fit, seen)
    if kinematics:
        plain = replace(fit, frames_by_links=plain.frames_by_links)
        return replace(plain, covariance=_covariance(_Linear.of(fit, seen), fit, seen))
    return plain


@dataclass(frozen=True, eq=False)
class _Linear:
    """The model near a fit, of n poses with m residuals each."""

    residuals: Floats  # (n, m) measured minus modelled
    slopes: (
        Floats  # (n, m, parameters) of the model: world_from_base, body_from_flange, clocks, links
    )
    by_pose: Floats  # (n, m, 6) of the residuals
    covariances: Floats  # (n, m, m) as the poses state

    @classmethod
    def of(cls, fit: FrameFit, seen: Sightings) -> _Linear:
        """Linearise."""
        base, flange, poses = fit.world_from_base, fit.body_from_flange, seen.poses.world_from_body
        reported, twist, by_links = seen.flange(fit.links, fit.clocks_s)
        hand = base @ reported
        R, n, clocks = base.rotation, len(seen.poses), FRAMES + len(seen.shared)
        S = np.zeros((n, 6, clocks + seen.links))
        E = np.broadcast_to(np.eye(6), (n, 6, 6)).copy()
        if seen.chain:
            model = hand @ flange.inverse()
            r = poses.difference(model)
            lever = model.translation - hand.translation
            S[:, :3, 6:9] = S[:, 3:, 9:12] = -model.rotation
            S[:, :3, 9:12] = -model.rotation @ skew(flange.translation)
        else:  # the reported point, as the cameras see it
            model, lever = hand, np.zeros((n, 3))
            r = poses.apply(np.broadcast_to(flange.translation, (n, 3))) - hand.translation
            S[:, :3, 6:9] = -poses.rotation
            E = E[:, :3]
            E[:, :, 3:] = -skew(poses.rotation @ flange.translation)
        S[:, :, :6] = np.eye(6)
        S[:, :3, 3:6] = -skew(model.translation - base.translation)
        by_hand = np.kron(np.eye(2), R)[None].repeat(n, axis=0)
        by_hand[:, :3, 3:] = -skew(lever) @ R
        S[:, :, clocks:] = by_hand @ by_links
        timed = np.einsum("nab,nb->na", by_hand, twist)
        S[np.arange(n), :, FRAMES + seen.recording] = timed
        size = E.shape[1]
        return cls(r, S[:, :size], E, propagate(E, seen.poses.covariances))

    @property
    def white(self) -> Floats:
        """Residuals (n, m) over what the poses state."""
        roots = np.linalg.cholesky(self.covariances)
        return np.asarray(np.linalg.solve(roots, self.residuals[..., None])[..., 0])

    def normal(self, extra: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """S' W (n, p, m), and its sums with slopes S and residuals; W allows for `extra` noise."""
        weighted = np.swapaxes(np.linalg.solve(self.covariances + extra, self.slopes), 1, 2)
        matrix = np.einsum("npm,nmk->pk", weighted, self.slopes, optimize=True)
        return weighted, matrix, np.einsum("npm,nm->p", weighted, self.residuals)


def _with_links(fit: FrameFit, seen: Sightings) -> FrameFit:
    """Everything at once; the links' standard deviations and the noise as well."""
    known = _precision(seen, fit.link_sd)[: FRAMES + len(seen.shared)]
    found = LinkEffects(known, known, fit.link_sd, fit.noise)
    for step in range(_STEPS):
        near = _Linear.of(fit, seen)
        _, N, g = near.normal()
        squares = float(squared_mahalanobis(near.residuals, near.covariances).sum())
        found = found.solved((N, g, squares, near.residuals.size), known, fit.links, fit.share)
        fit = replace(_moved(fit, seen, found.step), link_sd=found.link_sd, noise=found.noise)
        if step > 1 and np.all(np.abs(found.step) < 0.01 * np.sqrt(np.diag(found.covariance))):
            break
    return fit


def _without_links(fit: FrameFit, seen: Sightings) -> FrameFit:
    """Frames and clocks alone, weighted by all that is left; its covariance counts the links."""
    free = FRAMES + len(seen.shared)
    fitted = replace(fit, links=np.zeros_like(fit.links))
    for _ in range(_STEPS):
        near = _Linear.of(fitted, seen)
        spread = near.residuals.T @ near.residuals / len(near.residuals)
        weighted, N, g = near.normal(spread)
        x = np.zeros(N.shape[0])
        precision = np.diag(_precision(seen, fit.link_sd)[:free])
        x[:free] = np.linalg.solve(N[:free, :free] + precision, g[:free])
        fitted = _moved(fitted, seen, x)
        if np.abs(x).max() < 1e-6:
            break
    solved = np.linalg.solve(N[:free, :free] + precision, N[:free])
    by_links = solved[:, free:] * fit.link_sd
    gains = np.linalg.solve(N[:free, :free] + precision, weighted[:, :free])
    noise = _of_noise(gains @ near.by_pose, _Linear.of(fit, seen), seen)
    held = np.diag(precision)  # what only this holds is as uncertain as it says
    unknown = np.diag(np.divide(1.0, held, out=np.zeros_like(held), where=held > 0))
    covariance = by_links @ by_links.T + noise + unknown
    return replace(fitted, covariance=covariance, frames_by_links=by_links[:FRAMES])


def _covariance(near: _Linear, fit: FrameFit, seen: Sightings) -> Floats:
    """Of everything, links fitted: by the noise, and by what the links' prior leaves open."""
    weighted, N, _ = near.normal()
    precision = np.diag(_precision(seen, fit.link_sd))
    inverse = np.linalg.inv(N * (fit.share / fit.noise) + precision)
    noise = _of_noise(inverse @ weighted @ near.by_pose * (fit.share / fit.noise), near, seen)
    return np.asarray(noise + inverse @ precision @ inverse)


def _of_noise(gains: Floats, near: _Linear, seen: Sightings) -> Floats:
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
        scatter = float(np.mean(np.diff(own, axis=0) ** 2) / 2)
        if shared is not None:
            total += shared.of_sum(gains[rows], poses, scatter)
            level = max(level - max(scatter, 1.0), 0.0)
        total += level * propagate(gains[rows], poses.covariances).sum(axis=0)
    return total


def _precision(seen: Sightings, link_sd: Floats) -> Floats:
    """What is known beforehand of every parameter: nothing, but of links and unseen turns."""
    known = np.zeros(FRAMES + len(seen.shared))
    known[9:FRAMES] = 0.0 if seen.chain else _UNKNOWN_RAD**-2
    known[FRAMES:] = _EXACT_S**-2 if seen.clocks_known else 0.0
    return np.concatenate([known, link_sd**-2.0])


def _moved(fit: FrameFit, seen: Sightings, x: Floats) -> FrameFit:
    clocks = FRAMES + len(seen.shared)
    return replace(
        fit,
        world_from_base=fit.world_from_base.perturb(x[:6]),
        body_from_flange=fit.body_from_flange.perturb(x[6:FRAMES]),
        clocks_s=fit.clocks_s + x[FRAMES:clocks],
        links=fit.links + x[clocks:],
    )


def _closed_form(seen: Sightings) -> tuple[RigidTransform, RigidTransform]:
    """world_from_base and body_from_flange: rotations first, then translations."""
    poses = seen.poses.world_from_body
    hand, _, _ = seen.flange(np.zeros(seen.links), np.zeros(len(seen.shared)))
    flange = np.eye(3)
    if seen.chain:
        base, flange, _ = align_turns(hand.rotation, poses.rotation)
    else:  # R_pose p + t = A reported + b, linear in p, A and b
        unit = np.broadcast_to(np.eye(3), poses.rotation.shape)
        spread = np.einsum("nk,ij->nikj", hand.translation, np.eye(3)).reshape(-1, 3, 9)
        rows = np.concatenate([spread, unit, -poses.rotation], axis=2).reshape(-1, 15)
        base = _nearest_rotation(np.linalg.lstsq(rows, poses.translation.ravel())[0][:9])
    rows = np.concatenate(
        [np.broadcast_to(np.eye(3), poses.rotation.shape), -poses.rotation], axis=2
    )
    wanted = poses.translation - hand.translation @ base.T
    x = np.linalg.lstsq(rows.reshape(-1, 6), wanted.ravel())[0]
    return RigidTransform(base, x[:3]), RigidTransform(flange, x[3:])


def align_turns(hand: Floats, pose: Floats) -> tuple[Floats, Floats, float]:
    """Rotations world_from_base and body_from_flange, of base_from_flange and world_from_body.

    Those are (n, 3, 3); last the angle, rad RMS, by which they miss each other.
    """
    # With vec by columns, vec(R_base) = (R_hand x R_pose) vec(R_flange).
    u, sizes, v = np.linalg.svd(np.einsum("nab,ncd->acbd", hand, pose).reshape(9, 9))
    apart = np.sqrt(3 * max(0.0, 1 - sizes[0] / len(hand)))
    return _nearest_rotation(u[:, 0]), _nearest_rotation(v[0]), float(apart)


def _nearest_rotation(columns: Floats) -> Floats:
    """Of a matrix (9,) by columns, of any size and sign."""
    matrix = columns.reshape(3, 3).T
    u, _, v = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(u @ v)

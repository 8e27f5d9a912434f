"""Slips of a registration, each undone in turn: the one that makes all fit is the cause.

Two kinds. What is wrong altogether (axes of a left hand, joints in another order) is looked for by
the closed form, which needs no start. What is wrong by a little (the scale of the cameras, a camera
that was pushed) is one more unknown of the fit.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats, Ints, rms_length
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.geometry.covariance import inverted, posterior_covariance
from measure.limits import CLEAR_RATIO, LEVER_MM
from measure.robots import SerialChain
from measure_learning.core.frame_fit import (
    FRAMES,
    FrameFit,
    LinearModel,
    Sightings,
    fit_frames,
    precision,
    quick_miss,
    turns_agree,
)
from measure_learning.robots.links import usual_sd

_COMPARED, _FITTED = 60, 120  # poses by which slips are ranked, and the best of them fitted
_FINALISTS = 4  # slips ranked by all, after the rotations alone; and those fitted
_MOST_LEFT = 0.1  # share of the motion that may be left then
_MOST_JOINTS = 7  # whose orders are all tried: 5040
_EXPLAINED = 0.6  # share of the RMS up to which one more unknown leaves it, to be the cause
_LEAST_SCALE, _MOST_SCALE = 2e-3, 0.2
"""Errors of the cameras' scale: those of long links look like smaller ones; by more nothing fits.
"""
_SCALE_ROUNDS = 3  # of weighing by what is left: at first the scale is in it
_LEAST_JUMP_MM, _LEAST_JUMP_RAD = 0.5, 0.002
_WEIGHED = 600  # poses by which small changes are looked for
_CUTS = 40  # places in time where a jump is looked for
_EDGE = 0.08  # share of the poses that must be on either side


@dataclass(frozen=True, eq=False)
class _KnownSlip:
    """What may be wrong, and the sightings with it undone."""

    said: str
    cure: str
    undone: Sightings


def explain(seen: Sightings, joint_names: Sequence[str], eye_in_hand: bool = False) -> str | None:
    """The slip without which base and tool explain poses that they do not explain now; or None."""
    if seen.chain is None:
        return None
    few = seen.take(_some(len(seen.poses), _COMPARED))
    every = _slips(few, joint_names, eye_in_hand)
    likely = heapq.nlargest(_COMPARED, every, key=lambda slip: turns_agree(slip.undone))
    ranked = sorted(likely, key=lambda slip: quick_miss(slip.undone))
    wanted = {slip.said for slip in ranked[:_FINALISTS]}
    more = seen.take(_some(len(seen.poses), _FITTED))
    slips = [slip for slip in _slips(more, joint_names, eye_in_hand) if slip.said in wanted]
    before = _left_mm(more)
    left, best = min(((_left_mm(slip.undone), slip) for slip in slips), key=lambda pair: pair[0])
    places = best.undone.poses.world_from_body.translation
    spread = float(np.linalg.norm(places.std(axis=0)))
    if left > before / CLEAR_RATIO or left > max(_MOST_LEFT * spread, 1.0):
        return None
    return (
        f"{best.said}: {left:.2f} mm are left once that is undone, {before:.0f} mm as it is: "
        f"{best.cure}"
    )


def _size_mm(residuals: Floats) -> float:
    """RMS of residuals (n, 3 or 6) in mm, turns at a lever."""
    levers = np.repeat([1.0, LEVER_MM], 3)[: residuals.shape[1]]
    return float(rms_length(residuals * levers))


def _some(count: int, most: int) -> slice:
    return slice(None, None, -(-count // most))


def _left_mm(seen: Sightings) -> float:
    """RMS that a fit of base, tool and clock leaves, turns at a lever; more for poses left out."""
    try:
        fit = fit_frames(seen, kinematics=False)
    except (np.linalg.LinAlgError, DegenerateGeometryError):
        return float("inf")
    return _size_mm(fit.residuals(seen.take(fit.kept))) / max(float(fit.kept.mean()) ** 3, 1e-3)


def _slips(seen: Sightings, names: Sequence[str], eye_in_hand: bool) -> Iterator[_KnownSlip]:
    assert seen.chain is not None
    poses = seen.poses
    back, P = inverted(poses.world_from_body, poses.covariances)
    if eye_in_hand:
        said = "the cameras stand in the world and the body is on the tool"
        cure = "leave out --eye-in-hand"
    else:
        said = "the poses fit when they are inverted"
        cure = (
            "if the cameras are on the flange and the body stands in the world, give --eye-in-hand;"
            " else the table holds body_from_world: invert it"
        )
    undone = replace(poses, world_from_body=back, covariances=P)
    yield _KnownSlip(said, cure, replace(seen, poses=undone))
    place = poses.world_from_body
    for mirror, how in _MIRRORS:
        both = RigidTransform(mirror @ place.rotation @ mirror, place.translation @ mirror)
        said = "the poses are of a left hand's axes (one is mirrored, or two are exchanged)"
        others = [(f"{how} in the poses' positions", replace(both, rotation=place.rotation))]
        if mirror is _MIRRORS[0][0]:
            others.append((said, both))
        for said, other in others:
            cure = "write positions and rotations in the same axes, of a right hand"
            yield _KnownSlip(said, cure, replace(seen, poses=replace(poses, world_from_body=other)))
    yield from _joint_slips(seen, seen.chain, names)
    if seen.apart:
        yield from _row_slips(seen)


_MIRRORS = (
    (np.diag([-1.0, 1, 1]), "x is mirrored"),
    (np.diag([1.0, -1, 1]), "y is mirrored"),
    (np.diag([1.0, 1, -1]), "z is mirrored"),
    (np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]), "x and y are exchanged"),
    (np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]), "x and z are exchanged"),
    (np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), "y and z are exchanged"),
)


def _joint_slips(seen: Sightings, chain: SerialChain, names: Sequence[str]) -> Iterator[_KnownSlip]:
    n = chain.size
    orders = itertools.permutations(range(n)) if n <= _MOST_JOINTS else _exchanges(n)
    for order in itertools.islice(orders, 1, None):
        held = ", ".join(names[k] for k in order)
        said = f"the joints are in another order ({held} are the robot's 1 to {n})"
        cure = "name the columns in the robot's order (robot.toml, [log] joints)"
        yield _KnownSlip(said, cure, _with_joints(seen, chain, list(order), np.ones(n)))
    for count in (1, 2, 3):
        for some in itertools.combinations(range(n), count):
            signs = np.ones(n)
            signs[list(some)] = -1.0
            which = " and ".join(names[k] for k in some)
            turn = "turns" if count == 1 else "turn"
            said, cure = f"{which} {turn} the other way", "reverse that in the log"
            yield _KnownSlip(said, cure, _with_joints(seen, chain, list(range(n)), signs))


def _row_slips(seen: Sightings) -> Iterator[_KnownSlip]:
    """Stops whose poses and joints are out of step by a row, all or from one of them on."""
    n = len(seen.poses)
    for first, (early, where) in itertools.product(range(n - 1), ((0, "below"), (1, "above"))):
        poses = np.delete(np.arange(n), -1 if early else first)
        states = np.delete(np.arange(n), first if early else -1)
        since = f"from stop {first + 1} on " if first else ""
        said = f"{since}each pose is one row {where} its joints"
        cure = "pair them again: is a row missing, or there twice?"
        undone = replace(seen.take(states), poses=seen.poses.take(poses))
        yield _KnownSlip(said, cure, undone)


def _exchanges(n: int) -> Iterator[tuple[int, ...]]:
    yield tuple(range(n))
    for a, b in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[a], order[b] = b, a
        yield tuple(order)


def _with_joints(seen: Sightings, chain: SerialChain, order: list[int], signs: Floats) -> Sightings:
    joints = seen.joints[:, order] * signs
    return replace(
        seen, joints=joints, rates=seen.rates[:, order] * signs, reported_mm=chain.tip_mm(joints)
    )


@dataclass(frozen=True, eq=False)
class Misfit:
    """What frames leave of n poses or positions, and what could make it."""

    residuals: Floats  # (n, m) mm, and rad where there are rotations
    slopes: Floats  # (n, m, p) of what is fitted anew: frames, clocks
    known: Floats  # (p,) inverse variances of these beforehand
    covariances: Floats  # (n, m, m) as measured
    places_mm: Floats  # (n, 3)
    recording: Ints  # (n,) from 0 on
    times_s: Floats | None  # (n,) None where no jump in time is looked for
    by_tool: Floats | None = None  # (n, m, k) by the body's place on the tool
    by_links: Floats | None = None  # (n, m, links) by errors of the links, of the usual size

    @classmethod
    def of(cls, fit: FrameFit, seen: Sightings) -> Misfit:
        """Of a fit of base, tool and clocks."""
        near, free = LinearModel.of(fit, seen), FRAMES + len(seen.shared)
        return cls(
            near.residuals,
            near.slopes[:, :, :free],
            precision(seen, fit.link_sd)[:free],
            near.covariances,
            seen.poses.world_from_body.translation,
            seen.recording,
            None if seen.apart else seen.poses.times_s,
            None if seen.chain is None else near.slopes[:, :, 6:FRAMES],
            near.slopes[:, :, free:],
        )

    def left_with(self, extra: Floats) -> tuple[float, Floats]:
        """RMS in mm that is left with more unknowns, of slopes (n, m, k); their values (k,)."""
        few = _some(len(self.residuals), _WEIGHED)
        slopes = np.concatenate([self.slopes[few], extra[few]], axis=2)
        r = self.residuals[few]
        # Poses that state no covariance and differ by a constant leave it singular.
        weights = np.linalg.pinv(self.covariances[few].mean(axis=0) + r.T @ r / len(r))
        N = np.einsum("nap,ab,nbq->pq", slopes, weights, slopes, optimize=True)
        g = np.einsum("nap,ab,nb->p", slopes, weights, r, optimize=True)
        known = np.concatenate([self.known, np.zeros(extra.shape[2])])
        x = posterior_covariance(N, known) @ g
        return _size_mm(r - slopes @ x), x[len(self.known) :]

    def scale(self, by_scale: Floats) -> tuple[float, float]:
        """The cameras' scale beyond 1 and its SD, by its slopes (n, m, 1).

        Links that are all too long look the same, and without them a third of the scale is taken
        for the base's and the tool's.
        """
        few = _some(len(self.residuals), _WEIGHED)
        links = self.slopes[:, :, :0] if self.by_links is None else self.by_links
        slopes = np.concatenate([self.slopes[few], links[few], by_scale[few]], axis=2)
        of_links = usual_sd(links.shape[2]) ** -2.0
        known = np.concatenate([self.known, of_links, [_MOST_SCALE**-2.0]])
        r = left = self.residuals[few]
        for _ in range(_SCALE_ROUNDS):
            weights = np.linalg.pinv(self.covariances[few].mean(axis=0) + left.T @ left / len(r))
            N = np.einsum("nap,ab,nbq->pq", slopes, weights, slopes, optimize=True)
            C = posterior_covariance(N, known)
            x = C @ np.einsum("nap,ab,nb->p", slopes, weights, r, optimize=True)
            left = r - slopes @ x
        return float(x[-1]), float(np.sqrt(C[-1, -1]))


def changed(misfit: Misfit, own_mm: float = np.inf) -> str | None:
    """A scale of the cameras, or a jump of world or body, that explains what is left; or None.

    It must explain clearly more than the robot's own errors, where these leave `own_mm`.
    """
    places, size = misfit.places_mm, misfit.residuals.shape[1]
    by_scale = np.zeros((len(places), size, 1))
    by_scale[:, :3, 0] = places - places.mean(axis=0)
    found = [(*misfit.left_with(by_scale), "", 0.0), *_jumps(misfit)]
    before = misfit.left_with(by_scale[:, :, :0])[0]
    left, x, what, at_s = min(found, key=lambda one: one[0])
    if not left < _EXPLAINED * min(before, own_mm):
        return None
    turns = f" (turns at {LEVER_MM:g} mm)" if size > 3 else ""
    words = f"{left:.2f} mm are left then, {before:.2f} mm as it is{turns}"
    if not what:
        if not _LEAST_SCALE < abs(x[0]) < _MOST_SCALE:
            return None
        scale, sd = misfit.scale(by_scale)
        return (
            f"the cameras' world is {1 + scale:.4f} times as large as the robot's, SD {sd:.4f}: "
            f"{words}: was the "
            "board's square size that of the print, and the body file that of the body? Calibrate "
            "again (or the robot's links are all too long by that)"
        )
    mm, rad = float(np.linalg.norm(x[:3])), float(np.linalg.norm(x[3:]))
    if mm < _LEAST_JUMP_MM and rad < _LEAST_JUMP_RAD:
        return None
    return (
        f"{what} moved by {mm:.1f} mm and {np.degrees(rad):.2f} deg at {at_s:.1f} s of the "
        f"cameras' time: {words}: register what comes before and after apart"
    )


def _jumps(misfit: Misfit) -> Iterator[tuple[float, Floats, str, float]]:
    """What jumps at several times leave, with their sizes."""
    if misfit.times_s is None:
        return
    n, size = misfit.residuals.shape
    by_world = np.zeros((n, size, 6))
    by_world[:] = np.eye(6)[:size]
    by_world[:, :3, 3:] = -skew(misfit.places_mm - misfit.places_mm.mean(axis=0))
    whats = [("the cameras' world, or the robot's base,", by_world)]
    if misfit.by_tool is not None:
        whats.append(("the body on the tool", misfit.by_tool))
    for recording in np.unique(misfit.recording):
        rows = misfit.recording == recording
        cuts = np.quantile(misfit.times_s[rows], np.linspace(_EDGE, 1 - _EDGE, _CUTS)).tolist()
        for (what, slopes), cut in itertools.product(whats, cuts):
            late = rows & (misfit.times_s >= cut)
            if not _overlap(misfit.places_mm[rows & ~late], misfit.places_mm[late]):
                continue
            yield *misfit.left_with(slopes * late[:, None, None]), what, float(cut)


def _overlap(one: Floats, other: Floats) -> bool:
    """Whether places (n, 3) are among others (m, 3): else errors of the place look like a jump."""
    apart = float(np.linalg.norm(one.mean(axis=0) - other.mean(axis=0)))
    return apart < float(np.linalg.norm(one.std(axis=0)) + np.linalg.norm(other.std(axis=0))) / 2

"""Finding the body among the candidates of all cameras, or saying why it cannot be told.

Rays of two cameras that meet at the distance the outlines' sizes tell make possible ball centres;
three of them as far apart as in the body make a pose; the pose that most candidates agree with is
the body, unless another, different pose is about as good: then nobody can tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import Sightings, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import Candidates, by_ball, meeting_points
from measure.measuring.association.hypotheses import (
    Support,
    explained,
    poses_from_pairs,
    poses_from_triples,
    stack_candidates,
    support,
)
from measure.measuring.association.scoring import CandidateRows
from measure.measuring.association.second_body import signs_of_another
from measure.measuring.association.settings import AssociationSettings
from measure.model import Body, Camera, Detection

_ROUNDS = 2
_WELL_SEEN = 0.5
_SIZE_SD = 0.03
_MOST_MISFIT = 25.0
"""One outline alone may decide, but not beyond five standard deviations."""
_TOLERANCE = 1e-3
"""Steps, in mm and rad, that no longer change who agrees."""


@dataclass(frozen=True, eq=False)
class Association:
    """The body among the candidates.

    Attributes:
        world_from_body: the pose, or None if there is none or more than one.
        covariance: (6, 6) of the pose; None without one.
        detections: the chosen candidates, at most one per ball and camera.
        rms_px: RMS distance of the chosen candidates from the pose.
        reason: why there is no pose, in words; empty if there is one.
        doubts: what makes the pose one to doubt, in words.
    """

    world_from_body: RigidTransform | None
    covariance: Floats | None = None
    detections: tuple[Detection, ...] = ()
    rms_px: float = float("nan")
    reason: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Search:
    """What every step of one search needs."""

    body: Body
    cameras: Sequence[Camera]
    candidates: Sequence[Candidates]
    stacked: CandidateRows
    settings: AssociationSettings

    def support(self, poses: RigidTransform) -> Support:
        return support(poses, self.body, self.cameras, self.stacked, self.settings.range_ratio)

    def chosen(self, agreeing: Support, row: int) -> list[Detection]:
        return [
            self.candidates[ball].detections[index]
            for ball, by_camera in enumerate(agreeing.chosen[row])
            for index in by_camera
            if index >= 0
        ]


def associate(
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
    settings: AssociationSettings | None = None,
) -> Association:
    """Find the body.

    Args:
        body: what to look for; colours may repeat.
        cameras: all cameras.
        detections: candidates by camera name; several per ball, wrong ones among them.
        settings: tolerances.
    """
    settings = settings or AssociationSettings()
    candidates = by_ball(detections, body.balls, cameras)
    stacked = stack_candidates(candidates, settings.sigmas, settings.extra_px)
    search = _Search(body, cameras, candidates, stacked, settings)
    points = [
        meeting_points(c, settings.sigmas, settings.range_ratio, settings.max_points)
        for c in candidates
    ]
    for propose in (poses_from_triples, poses_from_pairs):
        found = _best(search, propose(body, points, settings.sigmas))
        if found is None:
            continue
        if found.world_from_body is None:
            return found
        doubts = signs_of_another(found.world_from_body, body, cameras, candidates, settings.sigmas)
        return replace(found, doubts=doubts)
    return Association(None, reason=_why_none(body, candidates, [len(p.points) for p in points]))


def _best(search: _Search, poses: RigidTransform) -> Association | None:
    """The accepted pose, or the statement that there are two; None if none is acceptable."""
    if not len(poses.translation):
        return None
    rough = search.support(poses)
    order = np.argsort(-rough.score, kind="stable")
    finalists: list[tuple[float, Association]] = []
    for row in _different(search, poses, rough, order.tolist()):
        refined = _refined(search, poses[int(row)], rough, int(row))
        if refined is not None and _is_new(search, refined[1], finalists):
            finalists.append(refined)
    if not finalists:
        return None
    if len(finalists) > 1:
        finalists.sort(key=lambda item: _size_misfit(search, item[1]) / _MOST_MISFIT - item[0])
    best_score, best = finalists[0]
    for score, rival in finalists[1:]:
        twin = _share_in_common(search, rival, best) > 0.5
        least = search.settings.twin_score if twin else search.settings.rival_score
        if score >= least * best_score and not (twin and _sizes_decide(search, best, rival)):
            return Association(None, reason=_ambiguous(best, rival))
    return best


def _sizes_decide(search: _Search, best: Association, rival: Association) -> bool:
    """Whether the outlines' sizes, as distances, contradict the rival and not the best."""
    return _size_misfit(search, rival) > _size_misfit(search, best) + search.settings.sigmas**2


def _size_misfit(search: _Search, found: Association) -> float:
    """Sum of squared relative errors of the outlines' radii, in standard deviations."""
    assert found.world_from_body is not None
    cameras = {camera.name: camera for camera in search.cameras}
    total = 0.0
    for d in found.detections:
        if d.score < _WELL_SEEN:
            continue
        ball = search.body.balls[search.body.index(d.ball)]
        away = found.world_from_body.apply(ball.center_mm) - cameras[d.camera].center
        tangent = np.sqrt(max(float(away @ away) - ball.radius_mm**2, 1.0))
        expected = cameras[d.camera].intrinsics.focal_px * ball.radius_mm / tangent
        sd = np.hypot(_SIZE_SD, np.sqrt(d.variance_px2) / expected)
        total += min(float(np.log(d.radius_px / expected) / sd) ** 2, _MOST_MISFIT)
    return total


def _share_in_common(search: _Search, rival: Association, best: Association) -> float:
    """How much of what a rival rests on lies on the best pose's balls as well."""
    assert best.world_from_body is not None
    names = [camera.name for camera in search.cameras]
    seen_by = np.array([names.index(d.camera) for d in rival.detections])
    pixels = np.stack([d.center_px for d in rival.detections])
    own = explained(best.world_from_body, search.body, search.cameras, seen_by, pixels)
    return float(np.mean(own))


def _different(search: _Search, poses: RigidTransform, rough: Support, order: Floats) -> list[int]:
    """The best few poses that differ from each other, of those that enough candidates back."""
    centers = search.body.centers @ np.swapaxes(poses.rotation, 1, 2) + poses.translation[:, None]
    least = max(search.settings.min_views, 0)
    kept: list[int] = []
    count = rough.count
    floor = 0.5 * search.settings.rival_score * float(np.max(rough.score))
    for row in order:
        if count[row] < least or rough.score[row] < floor:
            continue
        apart = [np.max(np.linalg.norm(centers[row] - centers[k], axis=1)) for k in kept]
        if not apart or min(apart) > search.settings.rival_mm:
            kept.append(int(row))
        if len(kept) == 6:
            break
    return kept


def _refined(
    search: _Search, pose: RigidTransform, agreeing: Support, row: int
) -> tuple[float, Association] | None:
    """Fit the pose to its candidates, look again who agrees, and accept it or not."""
    settings = search.settings
    by_name = {camera.name: camera for camera in search.cameras}
    covariance = np.eye(6)
    before: list[Detection] = []
    for _ in range(_ROUNDS):
        chosen = search.chosen(agreeing, row)
        if len(chosen) < settings.min_views:
            return None
        if [id(d) for d in chosen] == [id(d) for d in before]:
            break
        before = chosen
        time_s = sum(d.time_s for d in chosen) / len(chosen)
        try:
            seen = Sightings.of(chosen, search.body, by_name, time_s, settings.extra_px)
            fit = fit_pose(pose, seen, tolerance=_TOLERANCE)
        except DegenerateGeometryError:
            return None
        pose, covariance, row = fit.world_from_body, fit.covariance, 0
        agreeing = search.support(RigidTransform(pose.rotation[None], pose.translation[None]))
    chosen = search.chosen(agreeing, 0)
    enough = len(chosen) >= settings.min_views
    share = len(chosen) / max(1, int(agreeing.expected[0]))
    if not enough or share < settings.min_share or not _determined(chosen):
        return None
    rms = float(np.sqrt(np.vdot(fit.residuals_px, fit.residuals_px) / len(fit.residuals_px)))
    return float(agreeing.score[0]), Association(pose, covariance, tuple(chosen), rms)


def _determined(chosen: Sequence[Detection]) -> bool:
    """At least three balls, and at least two of them in two cameras."""
    count: dict[str, int] = {}
    for detection in chosen:
        count[detection.ball] = count.get(detection.ball, 0) + 1
    return len(count) >= 3 and sum(n >= 2 for n in count.values()) >= 2


def _is_new(
    search: _Search, found: Association, others: Sequence[tuple[float, Association]]
) -> bool:
    assert found.world_from_body is not None
    mine = found.world_from_body.apply(search.body.centers)
    for _, other in others:
        assert other.world_from_body is not None
        theirs = other.world_from_body.apply(search.body.centers)
        if np.max(np.linalg.norm(mine - theirs, axis=1)) < search.settings.rival_mm:
            return False
    return True


def _ambiguous(best: Association, rival: Association) -> str:
    places = []
    for found in (best, rival):
        assert found.world_from_body is not None
        x, y, z = found.world_from_body.translation
        places.append(f"({x:.0f}, {y:.0f}, {z:.0f}) mm")
    if places[0] == places[1]:
        return f"two poses of the body fit equally well at {places[0]}: nobody can tell which"
    return f"two bodies fit equally well, at {places[0]} and {places[1]}: take one out of view"


def _why_none(body: Body, candidates: Sequence[Candidates], meeting: Sequence[int]) -> str:
    unseen = [b.name for b, c in zip(body.balls, candidates, strict=True) if not len(c)]
    if len(unseen) == len(body.balls):
        return "no ball in view of any camera"
    if len(body.balls) - len(unseen) < 3:
        return f"too few balls in view: no candidate for {', '.join(unseen)}"
    apart = [b.name for b, n in zip(body.balls, meeting, strict=True) if not n]
    if len(body.balls) - len(apart) < 2:
        return (
            f"no two cameras agree on where {', '.join(apart)} "
            f"{'is' if len(apart) == 1 else 'are'}: check the calibration, "
            "and the radii in the body file"
        )
    return "no three candidates are as far apart as the body's balls"

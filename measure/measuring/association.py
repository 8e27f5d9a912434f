"""Association: the body among candidates of all cameras, or the reason why it is not determined.

Rays of two cameras that intersect at the distance that the outlines' sizes imply give possible ball
centres; three of them as far apart as in the body give a pose. The pose with the highest score is
the body, unless a different pose scores nearly as high: then the result is ambiguous.

A glossy table or a pane shows the body's mirror image. Of balls at p a mirror with unit normal n
shows images at q = p - 2 ((p - c) . n) n, with c in the plane. So all p - q are parallel to n and
all middles of p and q lie in the plane. Body and cameras are in front of the mirror and the images
behind it, which tells the body from its image.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.pose_hypotheses import (
    SLACK_MM,
    BallPoints,
    Candidates,
    PoseScores,
    by_ball,
    centers_of,
    intersect_rays,
    lie_on_balls,
    lie_on_body,
    poses_from_pairs,
    poses_from_triples,
    score_poses,
)
from measure.measuring.second_body import second_body_flags, unexplained
from measure.model import Body, Camera, Detection, Doubt, Rig

_MIRRORED_RANGE_RATIO = (
    1.15  # Largest error, as a factor, of the distance that an outline's size implies
)
_MAX_POINTS_PER_BALL = 12
_SURE_BALLS = 3  # Images of so many balls must be where the mirror shows them, if as many are seen


@dataclass(frozen=True, eq=False)
class Reflection:
    """A mirror image of the body."""

    normal: Floats  # (3,) of the plane, unit length, towards the body
    distance_mm: float  # of the middle of the balls from the plane
    detections: tuple[Detection, ...]  # candidates that lie on the images of balls
    others: tuple[Candidates, ...]  # of every ball, the candidates that do not

    def left_out_of(
        self, detections: Mapping[str, Sequence[Detection]]
    ) -> dict[str, list[Detection]]:
        """All detections but those of the image, by camera name."""
        own = {id(d) for d in self.detections}
        return {name: [d for d in some if id(d) not in own] for name, some in detections.items()}

    @property
    def note(self) -> Doubt:
        """What is in view, with the plane, and what to do."""
        x, y, z = np.round(self.normal, 2) + 0.0
        return Doubt("reflection", distance_mm=self.distance_mm, x=x, y=y, z=z)


def find_reflection(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    candidates: Sequence[Candidates],
    sigmas: float,
    is_image: bool = False,
) -> Reflection | None:
    """The mirror image of the body found, if some plane shows it there; else None.

    Two balls that are located where a mirror shows them suffice, and three if three are located.

    Args:
        candidates: of every ball, those that do not lie on the body.
        sigmas: points fit within this many standard deviations.
        is_image: the body found is the image; look for the real one. All cameras are on the
            image's side.
    """
    centers = world_from_body.apply(body.centers)
    located = [
        intersect_rays(c, sigmas, _MIRRORED_RANGE_RATIO, _MAX_POINTS_PER_BALL) for c in candidates
    ]
    seen = sum(len(points.points) > 0 for points in located)
    if seen < 2:
        return None
    best, most = None, 0
    for normal, offset_mm in _planes(centers, located):
        heights = centers @ normal - offset_mm
        images = centers - 2 * heights[:, None] * normal
        near = sum(_is_located(i, p, sigmas) for i, p in zip(images, located, strict=True))
        if near < min(seen, _SURE_BALLS) or np.any(heights <= 0):
            continue
        front = np.array([(camera.center @ normal > offset_mm) != is_image for camera in cameras])
        if is_image and not front.all():
            continue
        shown = [_shown(images, body, cameras, front, some) for some in candidates]
        views = [some.rays.cameras[own] for some, own in zip(candidates, shown, strict=True)]
        count = sum(len(own) for own in views)
        if count > most and sum(len(set(own.tolist())) >= 2 for own in views) >= 2:
            both = list(zip(candidates, shown, strict=True))
            on = (d for some, own in both for d in some.rows(np.flatnonzero(own)).detections)
            rest = tuple(some.rows(np.flatnonzero(~own)) for some, own in both)
            best, most = Reflection(normal, float(np.mean(heights)), tuple(on), rest), count
    return best


def _planes(centers: Floats, located: Sequence[BallPoints]) -> Iterator[tuple[Floats, float]]:
    """Normals (3,) and offsets in mm of the planes between two balls and points of their kinds."""
    for i, j in combinations(range(len(centers)), 2):
        for one in located[i].points:
            for other in located[j].points:
                across = centers[i] - one + centers[j] - other
                length = float(np.linalg.norm(across))
                if length > 0:
                    normal = across / length
                    middle = (centers[i] + one + centers[j] + other) / 4
                    yield normal, float(middle @ normal)


def _is_located(image: Floats, points: BallPoints, sigmas: float) -> bool:
    off = np.linalg.norm(points.points - image, axis=1)
    return bool(np.any(off < sigmas * points.sd_mm + SLACK_MM))


def _shown(
    images: Floats, body: Body, cameras: Sequence[Camera], front: Bools, some: Candidates
) -> Bools:
    """Which candidates (n,) of cameras in front of the mirror lie on the images of balls."""
    own = lie_on_balls(images, body.radii, cameras, some.rays.cameras, some.pixels)
    return np.asarray(own & front[some.rays.cameras])


_SIGMAS = 3.5  # Candidates agree with a pose within this many standard deviations
_EXTRA_PX = 1.5  # Added to every candidate's standard deviation in quadrature
_RANGE_RATIO = 1.4  # Largest error, as a factor, of the distance that an outline's size implies
MIN_VIEWS, _MIN_SHARE = 5, 0.4
"""Least number of balls found, counted in every camera, and least share of those in view."""
_RIVAL_SCORE, _TWIN_SCORE = 0.5, 0.9
"""Another pose whose score is this share of the best one's makes the result ambiguous; and one that
rests mostly on the same candidates, as a mirror image does."""
_RIVAL_MM = 8.0  # Poses count as different if some ball is this far apart
_MAX_POINTS = 40  # Most possible centres kept per ball
_MAX_ITERATIONS = 2
_MAX_FINALISTS = 6
_MIN_SCORE = 0.5  # Score of a candidate that counts as a ball
_UNITS_MM = {"cm": 10.0, "inches": 25.4}  # Of body files; one in m is refused when it is read
_CONVERGED = 1e-3  # Steps, in mm and rad, that no longer change which candidates agree
_TWIN_SHARE = 0.5  # Share of common candidates from which a rival pose is a twin of the best one


@dataclass(frozen=True, eq=False)
class Association:
    """The body among the candidates."""

    world_from_body: RigidTransform | None  # the pose, or None if there is none or more than one
    covariance: Floats | None = None  # (6, 6) of the pose; None without one
    detections: tuple[Detection, ...] = ()  # the chosen candidates, at most one per ball and camera
    rms_px: float = float("nan")  # RMS distance of the chosen candidates from the pose
    reason: str = ""  # why there is no pose, in words; empty if there is one
    flags: tuple[str, ...] = ()
    # cameras that see two or more balls well, but none where the body found should appear
    disagreeing: tuple[str, ...] = ()
    # the mirror image of the body, which is left out; None without one.
    reflection: Reflection | None = None


@dataclass(frozen=True, eq=False)
class _AssociationProblem:
    """The inputs of one association."""

    body: Body
    cameras: Sequence[Camera]
    candidates: Sequence[Candidates]

    def score(self, poses: RigidTransform) -> PoseScores:
        limits_px = [_SIGMAS * np.hypot(some.sd_px, _EXTRA_PX) for some in self.candidates]
        return score_poses(poses, self.body, self.cameras, self.candidates, limits_px, _RANGE_RATIO)

    def chosen(self, agreeing: PoseScores, row: int) -> list[Detection]:
        return [
            self.candidates[ball].detections[index]
            for ball, by_camera in enumerate(agreeing.chosen[row])
            for index in by_camera
            if index >= 0
        ]

    def why_none(self, points: Sequence[BallPoints], other_unit: Callable[[], str]) -> str:
        """The reason why there is no pose hypothesis; where cameras disagree `other_unit` first."""
        names = self.body.names
        unseen = [name for name, c in zip(names, self.candidates, strict=True) if not len(c)]
        if len(unseen) == len(names):
            return Doubt("no-ball")
        if len(names) - len(unseen) < 3:
            return Doubt("few-balls", balls=unseen)
        apart = [name for name, p in zip(names, points, strict=True) if not len(p.points)]
        if len(names) - len(apart) < 2:
            return other_unit() or Doubt("rays-apart", balls=apart)
        return Doubt("no-triple")


def associate(
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
    units_mm: Mapping[str, float] = _UNITS_MM,
) -> Association:
    """Find the body by candidates, several per ball and wrong ones too; colours may repeat.

    Where cameras agree on no two balls, its lengths are tried in other units, for the reason.
    """
    candidates = by_ball(detections, body.balls, cameras)
    problem = _AssociationProblem(body, cameras, candidates)
    points = [intersect_rays(c, _SIGMAS, _RANGE_RATIO, _MAX_POINTS) for c in candidates]
    for propose in (poses_from_triples, poses_from_pairs):
        rivals = _best(problem, propose(body, points, _SIGMAS))
        if not rivals:
            continue
        for found in rivals:
            assert found.world_from_body is not None
            left = unexplained(found.world_from_body, body, cameras, candidates)
            mirrored = find_reflection(found.world_from_body, body, cameras, left, _SIGMAS)
            if mirrored is None:
                mirrored = _taken_for_the_body(found, body, cameras, detections, left)
            if mirrored is not None:
                again = associate(body, cameras, mirrored.left_out_of(detections), units_mm)
                return replace(again, reflection=again.reflection or mirrored)
        if len(rivals) > 1:
            return Association(None, reason=_ambiguous(*rivals))
        flags = second_body_flags(body, left, _SIGMAS)
        against = tuple(_disagreeing(found, body, cameras, detections))
        return replace(found, flags=flags, disagreeing=against)
    other_unit = partial(_other_unit, body, cameras, detections, units_mm)
    return Association(None, reason=problem.why_none(points, other_unit))


def _taken_for_the_body(
    found: Association,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
    left: Sequence[Candidates],
) -> Reflection | None:
    """The body found itself, if it is a mirror image of what else is seen.

    Where few cameras see some of the body's own balls, its image may fit better.
    """
    assert found.world_from_body is not None
    seen = find_reflection(found.world_from_body, body, cameras, left, _SIGMAS, is_image=True)
    if seen is None:
        return None
    others = {id(d) for some in left for d in some.detections}
    own = (d for some in detections.values() for d in some if id(d) not in others)
    return replace(seen, normal=-seen.normal, detections=tuple(own), others=tuple(left))


def _other_unit(
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
    units_mm: Mapping[str, float],
) -> str:
    """That the body is found if the lengths of its file are in another unit; empty if not."""
    for unit, mm in units_mm.items():
        balls = tuple(
            replace(ball, center_mm=mm * ball.center_mm, radius_mm=mm * ball.radius_mm)
            for ball in body.balls
        )
        found = associate(replace(body, balls=balls), cameras, detections, {})
        if found.world_from_body is not None:
            return Doubt("body-unit", times=mm, unit=unit)
    return ""


def _disagreeing(
    found: Association,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
) -> Iterator[str]:
    """Cameras that see two or more balls well, but none where the body should appear."""
    assert found.world_from_body is not None
    centers = found.world_from_body.apply(body.centers)
    agreeing = {d.camera for d in found.detections}
    for camera in (camera for camera in cameras if camera.name not in agreeing):
        in_view = int(np.sum(camera.intrinsics.contains(camera.project(centers))))
        good = {d.ball for d in detections.get(camera.name, ()) if d.score >= _MIN_SCORE}
        if len(good) >= 2 and (in_view >= 2 or in_view == 0):
            yield camera.name


def second_body(
    world_from_body: RigidTransform,
    body: Body,
    cameras: Sequence[Camera],
    detections: Mapping[str, Sequence[Detection]],
) -> tuple[str, ...]:
    """A flag if whole images of `cameras` may show another body like the one tracked."""
    candidates = by_ball(detections, body.balls, cameras)
    left = unexplained(world_from_body, body, cameras, candidates)
    mirrored = find_reflection(world_from_body, body, cameras, left, _SIGMAS)
    return second_body_flags(body, left if mirrored is None else mirrored.others, _SIGMAS)


def _best(problem: _AssociationProblem, poses: RigidTransform) -> list[Association]:
    """The accepted pose, and a different one that fits as well; empty if none is acceptable."""
    if not len(poses.translation):
        return []
    rough = problem.score(poses)
    order = np.argsort(-rough.score, kind="stable")
    finalists: list[tuple[float, Association]] = []
    for row in _different(problem, poses, rough, order.tolist()):
        refined = _refined(problem, poses[row], rough, row)
        if refined is not None and _is_new(problem, refined[1], finalists):
            finalists.append(refined)
    if not finalists:
        return []
    finalists.sort(key=lambda item: -item[0])
    best_score, best = finalists[0]
    for score, rival in finalists[1:]:
        twin = _common_share(problem, rival, best) > _TWIN_SHARE
        least = _TWIN_SCORE if twin else _RIVAL_SCORE
        if score >= least * best_score:
            return [best, rival]
    return [best]


def _common_share(problem: _AssociationProblem, rival: Association, best: Association) -> float:
    """Share of a rival's candidates that lie on balls of the best pose as well."""
    assert best.world_from_body is not None
    names = [camera.name for camera in problem.cameras]
    seen_by = np.array([names.index(d.camera) for d in rival.detections])
    pixels = np.stack([d.center_px for d in rival.detections])
    own = lie_on_body(best.world_from_body, problem.body, problem.cameras, seen_by, pixels)
    return float(np.mean(own))


def _different(
    problem: _AssociationProblem, poses: RigidTransform, rough: PoseScores, order: Sequence[int]
) -> list[int]:
    """The best poses, as rows, that differ from each other and have enough candidates."""
    centers = centers_of(problem.body, poses)
    kept: list[int] = []
    floor = 0.5 * _RIVAL_SCORE * float(np.max(rough.score))
    enough = (rough.count >= MIN_VIEWS) & (rough.score >= floor)
    for row in order:
        if not enough[row]:
            continue
        apart = [np.max(np.linalg.norm(centers[row] - centers[k], axis=1)) for k in kept]
        if not apart or min(apart) > _RIVAL_MM:
            kept.append(row)
        if len(kept) == _MAX_FINALISTS:
            break
    return kept


def _refined(
    problem: _AssociationProblem, pose: RigidTransform, agreeing: PoseScores, row: int
) -> tuple[float, Association] | None:
    """Alternate fitting the pose and choosing the agreeing candidates; None if not acceptable."""
    by_name = {camera.name: camera for camera in problem.cameras}
    covariance = np.eye(6)
    before: list[Detection] = []
    for _ in range(_MAX_ITERATIONS):
        chosen = problem.chosen(agreeing, row)
        if len(chosen) < MIN_VIEWS:
            return None
        if [id(d) for d in chosen] == [id(d) for d in before]:
            break
        before = chosen
        time_s = sum(d.time_s for d in chosen) / len(chosen)
        try:
            seen = PoseObservations.of(chosen, problem.body, by_name, time_s, _EXTRA_PX)
            fit = fit_pose(pose, seen, tolerance=_CONVERGED)
        except DegenerateGeometryError:
            return None
        pose, covariance, row = fit.world_from_body, fit.covariance, 0
        agreeing = problem.score(RigidTransform(pose.rotation[None], pose.translation[None]))
    chosen = problem.chosen(agreeing, 0)
    enough = len(chosen) >= MIN_VIEWS
    share = len(chosen) / max(1, int(agreeing.expected[0]))
    if not enough or share < _MIN_SHARE or not _determined(chosen):
        return None
    rms = float(np.sqrt(np.vdot(fit.residuals_px, fit.residuals_px) / len(fit.residuals_px)))
    return float(agreeing.score[0]), Association(pose, covariance, tuple(chosen), rms)


def _determined(chosen: Sequence[Detection]) -> bool:
    """Whether three or more balls are seen, at least two of them by two cameras."""
    count = Counter(detection.ball for detection in chosen)
    return len(count) >= 3 and sum(n >= 2 for n in count.values()) >= 2


def _is_new(
    problem: _AssociationProblem, found: Association, others: Sequence[tuple[float, Association]]
) -> bool:
    """Whether a pose differs from all others."""
    assert found.world_from_body is not None
    mine = found.world_from_body.apply(problem.body.centers)
    for _, other in others:
        assert other.world_from_body is not None
        theirs = other.world_from_body.apply(problem.body.centers)
        if np.max(np.linalg.norm(mine - theirs, axis=1)) < _RIVAL_MM:
            return False
    return True


def _ambiguous(best: Association, rival: Association) -> str:
    assert best.world_from_body is not None
    assert rival.world_from_body is not None
    one, other = best.world_from_body.translation, rival.world_from_body.translation
    (x, y, z), (u, v, w) = one, other
    if np.array_equal(one.round(), other.round()):
        return Doubt("two-poses", x_mm=x, y_mm=y, z_mm=z)
    return Doubt("two-bodies", x_mm=x, y_mm=y, z_mm=z, other_x_mm=u, other_y_mm=v, other_z_mm=w)


def warm_up(cameras: Sequence[Camera]) -> None:
    """Compile the loops of a search, or load them, by running them on one candidate."""
    seen = PoseObservations(
        Rig.of(cameras[:1]),
        np.zeros((1, 3)),
        np.zeros(1, np.int64),
        np.zeros((1, 2)),
        np.eye(2)[None],
        np.zeros(1),
    )
    seen.rig.rays(seen.pixels)
    with contextlib.suppress(DegenerateGeometryError):
        fit_pose(RigidTransform.identity(), seen)

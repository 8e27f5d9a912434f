"""Whether circles of one ball in several cameras can be one ball of the known size.

And the start: the paper takes the first circle of each colour and camera for effective, false ones
included. Here a circle must meet what the paper asks of a suspended one: it agrees with the other
cameras' circles in 3-D, and the balls lie as far apart as in the body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, usable_pairs
from measure.model import Ball, BallPosition, Body, Camera, Detection, Doubt, Pose, Rig
from measure_paper.midpoint import mean_midpoint

_MIN_ANGLE_RAD = np.radians(5.0)


@dataclass(frozen=True, eq=False)
class RayObservation:
    """A circle with its ray in the world."""

    detection: Detection
    camera: Camera
    origin: Floats  # (3,) the camera's centre in mm
    direction: Floats  # (3,) unit vector through the circle's centre


def ray_observations(
    detections: Sequence[Detection], cameras: Mapping[str, Camera]
) -> tuple[RayObservation, ...]:
    """The detections with their rays; one beyond the lens model's reach is left out."""
    if not detections:
        return ()
    used = [cameras[detection.camera] for detection in detections]
    rays = Rig.of(used).rays(np.stack([detection.center_px for detection in detections]))
    return tuple(
        RayObservation(*parts)
        for parts in zip(detections, used, rays.origins, rays.directions, strict=True)
        if np.all(np.isfinite(parts[3]))
    )


@dataclass(frozen=True)
class AgreementLimits:
    """How well circles of one ball must agree."""

    distance_mm: float  # largest distance of a ray from the ball's centre
    radius_share: float  # largest relative error of the circle's radius, given where the ball is


def locate(seen: Sequence[RayObservation]) -> Floats | None:
    """The mean (3,) of the midpoints of all pairs of rays; None if they do not determine one."""
    if len(seen) < 2:
        return None
    rays = Rays(np.stack([s.origin for s in seen]), np.stack([s.direction for s in seen]))
    try:
        pairs = usable_pairs(rays, _MIN_ANGLE_RAD)
    except DegenerateGeometryError:
        return None
    return mean_midpoint(rays.origins, rays.directions, pairs)


def apparent_radius_px(camera: Camera, point: Floats, radius_mm: float) -> float:
    """Outline radius of a ball at `point` (3,) in the world, near the middle of the picture."""
    distance = max(float(np.linalg.norm(point - camera.center)), 1.01 * radius_mm)
    return float(camera.intrinsics.focal_px * radius_mm / np.sqrt(distance**2 - radius_mm**2))


def misfit(seen: RayObservation, point: Floats, radius_mm: float, limits: AgreementLimits) -> float:
    """Largest deviation of a circle from a ball at `point` (3,), as a multiple of its limit."""
    offset = point - seen.origin
    if offset @ seen.direction <= 0:
        return float("inf")
    distance = float(np.linalg.norm(np.cross(offset, seen.direction)))
    expected = apparent_radius_px(seen.camera, point, radius_mm)
    radius_error = abs(seen.detection.radius_px / expected - 1)
    return max(distance / limits.distance_mm, radius_error / limits.radius_share)


def disagreeing(
    seen: Sequence[RayObservation], radius_mm: float, limits: AgreementLimits
) -> tuple[RayObservation, ...]:
    """The fewest circles to leave out, worst first, until the others agree.

    Of two circles that disagree either may be wrong: none is named.
    """
    kept, out = list(seen), []
    while len(kept) >= 3 and _worst(kept, radius_mm, limits) > 1:
        rests = [[s for s in kept if s is not one] for one in kept]
        best = int(np.argmin([_worst(rest, radius_mm, limits) for rest in rests]))
        out.append(kept[best])
        kept = rests[best]
    return tuple(out)


def _worst(seen: Sequence[RayObservation], radius_mm: float, limits: AgreementLimits) -> float:
    point = locate(seen)
    if point is None:
        return float("inf")
    return max(misfit(one, point, radius_mm, limits) for one in seen)


def residual_flags(
    positions: Sequence[BallPosition], pose: Pose, flag_residual_mm: float, flag_rays_mm: float
) -> tuple[str, ...]:
    """Flags of a pose whose balls or rays have large residuals.

    Args:
        flag_residual_mm: RMS misfit of the balls to the body from which it is flagged.
        flag_rays_mm: RMS distance of the rays from their balls from which it is flagged.
    """
    found = []
    if pose.residual_mm > flag_residual_mm:
        found.append(Doubt("shape", off_mm=pose.residual_mm))
    squares: dict[str, list[float]] = {}
    for position in positions:
        for camera, residual in zip(position.cameras, position.residuals_mm.tolist(), strict=True):
            squares.setdefault(camera, []).append(residual**2)
    if not squares:
        return tuple(found)
    rays_mm = float(np.sqrt(np.mean([square for each in squares.values() for square in each])))
    if rays_mm > flag_rays_mm:
        worst = max(squares, key=lambda name: float(np.mean(squares[name])))
        found.append(Doubt("rays", off_mm=rays_mm, camera=worst))
    return tuple(found)


_MAX_HYPOTHESES_PER_BALL = 5


@dataclass(frozen=True, eq=False)
class CircleChoice:
    """Circles that may be one ball."""

    point: Floats  # (3,) where the ball would be, mm
    members: Mapping[str, Detection]
    misfit: float  # the largest of theirs

    @property
    def quality(self) -> tuple[int, float]:
        """Sorts hypotheses, the best one highest."""
        return len(self.members), -self.misfit


def choose(
    body: Body,
    seen: Sequence[RayObservation],
    limits: AgreementLimits,
    distance_tolerance_mm: float,
) -> dict[str, CircleChoice]:
    """The best hypothesis for as many balls as possible, by ball.

    Args:
        body: its radii and its distances between balls decide.
        seen: all candidates, any number per ball and camera.
        limits: how well circles of one ball must agree.
        distance_tolerance_mm: how far the distance of two balls may be off.
    """
    offered = {ball.name: _hypotheses(ball, seen, limits) for ball in body.balls}
    best: dict[str, CircleChoice] = {}
    for chosen in _combinations(body, offered, distance_tolerance_mm):
        if _value(chosen) > _value(best):
            best = chosen
    return best


def _value(chosen: Mapping[str, CircleChoice]) -> tuple[int, int, float]:
    views = sum(len(hypothesis.members) for hypothesis in chosen.values())
    return len(chosen), views, -sum(hypothesis.misfit for hypothesis in chosen.values())


def _hypotheses(
    ball: Ball, seen: Sequence[RayObservation], limits: AgreementLimits
) -> list[CircleChoice]:
    """Every two circles of different cameras that agree, with all others that agree with them."""
    mine = [one for one in seen if one.detection.ball == ball.name]
    found: dict[frozenset[int], CircleChoice] = {}
    for first, second in combinations(mine, 2):
        if first.camera is second.camera:
            continue
        hypothesis = _grow([first, second], mine, ball.radius_mm, limits)
        if hypothesis is not None:
            found[frozenset(id(d) for d in hypothesis.members.values())] = hypothesis
    return sorted(found.values(), key=lambda h: h.quality, reverse=True)[:_MAX_HYPOTHESES_PER_BALL]


def _grow(
    seed: list[RayObservation],
    others: Sequence[RayObservation],
    radius_mm: float,
    limits: AgreementLimits,
) -> CircleChoice | None:
    point = locate(seed)
    if point is None or max(misfit(s, point, radius_mm, limits) for s in seed) > 1:
        return None
    members = list(seed)
    for name in {s.camera.name for s in others} - {s.camera.name for s in seed}:
        rivals = [s for s in others if s.camera.name == name]
        residual_flags = [misfit(s, point, radius_mm, limits) for s in rivals]
        if min(residual_flags) <= 1:
            members.append(rivals[int(np.argmin(residual_flags))])
    point = locate(members)
    if point is None:
        return None
    worst = max(misfit(s, point, radius_mm, limits) for s in members)
    if worst > 1:
        return None
    return CircleChoice(point, {s.camera.name: s.detection for s in members}, worst)


def _combinations(
    body: Body, offered: Mapping[str, Sequence[CircleChoice]], tolerance_mm: float
) -> list[dict[str, CircleChoice]]:
    """Every choice of at most one hypothesis per ball in which all distances fit the body."""
    distances = body.distances()
    chosen: list[dict[str, CircleChoice]] = [{}]
    for name in body.names:
        chosen += [
            {**before, name: hypothesis}
            for before in chosen
            for hypothesis in offered[name]
            if all(
                abs(
                    float(np.linalg.norm(hypothesis.point - other.point)) - distances[earlier, name]
                )
                <= tolerance_mm
                for earlier, other in before.items()
            )
        ]
    return chosen

"""One frame set looked at with no idea where the body is, and what every camera says about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.association import associate
from measure.measuring.tracking.predictive.pose_checks import strangers
from measure.model import Body, Camera, Detection

_SIZE_RATIO = 1.25
_NEIGHBOUR_S = 0.12
"""Frames further apart say little about the velocity."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """What was found.

    Attributes:
        time_s: mean time of the pictures.
        world_from_body: the pose most cameras agree on, or None.
        agreeing: the detections it rests on.
        nearest: per camera and ball, the candidate of about the right size nearest to where the
            ball should be, however far off.
        in_view: per camera, how many balls should lie in its picture.
        reason: why there is no pose.
        doubts: what makes the pose one to doubt.
        strangers: cameras that see balls, but none where the body should appear.
        velocity: (6,) in the pose's `perturb` chart, per second; zero if unknown.
    """

    time_s: float
    world_from_body: RigidTransform | None
    agreeing: tuple[Detection, ...]
    nearest: tuple[Detection, ...]
    in_view: Mapping[str, int]
    reason: str
    doubts: tuple[str, ...] = ()
    strangers: tuple[str, ...] = ()
    velocity: Floats = field(default_factory=lambda: np.zeros(6))


def with_velocities(surveys: Sequence[Surveyed]) -> list[Surveyed]:
    """Add velocities, from the nearest survey in time that has a pose, if it is near enough."""
    out = []
    for k, survey in enumerate(surveys):
        near = [
            other
            for other in surveys[max(k - 1, 0) : k + 2]
            if other is not survey
            and other.world_from_body is not None
            and 0 < abs(other.time_s - survey.time_s) < _NEIGHBOUR_S
        ]
        if survey.world_from_body is None or not near:
            out.append(survey)
            continue
        other = min(near, key=lambda o: abs(o.time_s - survey.time_s))
        assert other.world_from_body is not None
        step = other.world_from_body.difference(survey.world_from_body)
        out.append(replace(survey, velocity=step / (other.time_s - survey.time_s)))
    return out


def survey_frame_set(
    detections: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
    time_s: float,
    reach_px: float = 80.0,
) -> Surveyed:
    """Find the body among candidates, and each camera's candidates near it.

    Args:
        detections: candidates by camera name, from a search of whole pictures.
        body: the body.
        cameras: the cameras.
        time_s: of the frame set.
        reach_px: how far off a camera may see a ball for it to count as the same.
    """
    found = associate(body, cameras, detections)
    if found.world_from_body is None:
        return Surveyed(time_s, None, (), (), {}, found.reason)
    centers = found.world_from_body.apply(body.centers)
    nearest: list[Detection] = []
    in_view = {}
    for camera in cameras:
        pixels = camera.project(centers)
        in_view[camera.name] = int(np.sum(camera.intrinsics.contains(pixels)))
        distances = np.linalg.norm(centers - camera.center, axis=1)
        for k, ball in enumerate(body.balls):
            radius = camera.intrinsics.focal_px * ball.radius_mm / distances[k]
            near = [
                (float(np.linalg.norm(d.center_px - pixels[k])), d)
                for d in detections.get(camera.name, ())
                if d.ball == ball.name and 1 / _SIZE_RATIO < d.radius_px / radius < _SIZE_RATIO
            ]
            best = min(near, key=lambda item: item[0], default=None)
            if best is not None and best[0] < reach_px:
                nearest.append(best[1])
    return Surveyed(
        time_s,
        found.world_from_body,
        found.detections,
        tuple(nearest),
        in_view,
        "",
        found.doubts,
        strangers(found, body, cameras, detections),
    )

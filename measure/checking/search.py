"""Frame sets in which all was searched: where the body is, and what each camera sees near it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.association import Reflection, associate
from measure.model import Body, Camera, Detection

_RADIUS_RATIO = 1.25
_REACH_PX = 80.0  # Largest distance of a candidate from where the ball should be
_LOOSE_PX = 25.0  # By which two cameras may contradict each other where no two agree
_MAX_STEP_S = 0.12  # Longest time between two samples that give a velocity


@dataclass(frozen=True, eq=False)
class SearchSample:
    """The association of one frame set."""

    time_s: float  # mean time of the images
    world_from_body: RigidTransform | None  # the pose with the highest score, or None
    agreeing: tuple[Detection, ...]  # the detections it rests on
    # per camera and ball, the candidate of about the right size nearest to where the ball should
    # be, however far off.
    nearest: tuple[Detection, ...]
    reason: str
    flags: tuple[str, ...] = ()
    # those that see balls, but none where the body should appear.
    disagreeing_cameras: tuple[str, ...] = ()
    reflection: Reflection | None = None  # the body's mirror image, which is left out
    # (6,) in the pose's `perturb` chart, per second; zero if unknown.
    velocity: Floats = field(default_factory=lambda: np.zeros(6))


def with_velocities(samples: Sequence[SearchSample]) -> list[SearchSample]:
    """Add velocities, from the nearest sample in time that has a pose, if it is near enough."""
    out = []
    for k, sample in enumerate(samples):
        near = [
            other
            for other in samples[max(k - 1, 0) : k + 2]
            if other is not sample
            and other.world_from_body is not None
            and 0 < abs(other.time_s - sample.time_s) < _MAX_STEP_S
        ]
        if sample.world_from_body is None or not near:
            out.append(sample)
            continue
        other = min(near, key=lambda o: abs(o.time_s - sample.time_s))
        assert other.world_from_body is not None
        step = other.world_from_body.difference(sample.world_from_body)
        out.append(replace(sample, velocity=step / (other.time_s - sample.time_s)))
    return out


def loose_sample(
    detections: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
    time_s: float,
) -> SearchSample:
    """`search_sample` of cameras that stand far from where they should: rays need not meet."""
    stated = dict[int, Detection]()
    vague = dict[str, list[Detection]]()
    for name, own in detections.items():
        spread = _LOOSE_PX**2 * np.eye(2)
        vague[name] = [replace(d, covariance_px=d.covariance_px + spread) for d in own]
        stated |= {id(loose): d for loose, d in zip(vague[name], own, strict=True)}
    sample = search_sample(vague, body, cameras, time_s)
    agreeing, nearest = (
        tuple(stated[id(d)] for d in found) for found in (sample.agreeing, sample.nearest)
    )
    return replace(sample, agreeing=agreeing, nearest=nearest)


def search_sample(
    detections: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
    time_s: float,
) -> SearchSample:
    """Find the body among candidates by camera name, and each camera's candidates nearest to it."""
    found = associate(body, cameras, detections)
    if found.world_from_body is None:
        return SearchSample(time_s, None, (), (), found.reason)
    if found.reflection is not None:
        detections = found.reflection.left_out_of(detections)
    centers = found.world_from_body.apply(body.centers)
    nearest: list[Detection] = []
    for camera in cameras:
        pixels = camera.project(centers)
        distances = np.linalg.norm(centers - camera.center, axis=1)
        for k, ball in enumerate(body.balls):
            radius = camera.intrinsics.focal_px * ball.radius_mm / distances[k]
            near = [
                (float(np.linalg.norm(d.center_px - pixels[k])), d)
                for d in detections.get(camera.name, ())
                if d.ball == ball.name and 1 / _RADIUS_RATIO < d.radius_px / radius < _RADIUS_RATIO
            ]
            best = min(near, key=lambda item: item[0], default=None)
            if best is not None and best[0] < _REACH_PX:
                nearest.append(best[1])
    return SearchSample(
        time_s,
        found.world_from_body,
        found.detections,
        tuple(nearest),
        "",
        found.flags,
        found.disagreeing,
        found.reflection,
    )

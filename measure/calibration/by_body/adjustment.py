"""The joint adjustment of cameras that only the waved body has located.

It is that of refining, from a first calibration without prior knowledge: the first camera is
held, for it is the world, and all others are free. At the end the covariance is that of the rig's
shape, without the world's own place, turn and scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.by_body.lenses import LENS_KINDS, is_open, with_lens_kind
from measure.calibration.by_body.linking import LinkedRig
from measure.calibration.common_views import columns_of, shape_errors
from measure.calibration.refining.freeing import FREE_SD, HELD_SD, joint_prior
from measure.calibration.refining.procedure import compare_halves
from measure.calibration.refining.recording import Recording, ball_places, tracks_of
from measure.calibration.refining.refine import Refinement, refine_rig
from measure.geometry import RigidTransform
from measure.model import Body, Camera
from measure.model.body import USUAL_RADIUS_TOLERANCE_MM

_SETTLED_SDS = 0.5  # Cameras that moved by less than so many standard deviations are at rest
_BETTER = 0.995  # Share of the held-out error that a freer lens must leave at most
_WORLD_SD = np.array([1e-3] * 3 + [1e-6] * 3 + [1e-6])
"""Of the world's place (mm), turn (rad) and scale: it is what it is, but a covariance without
any would be singular."""


def loose_prior(cameras: Sequence[Camera]) -> Floats:
    """The covariance of all poses and free lens parameters: the first pose held, the rest free."""
    return joint_prior(cameras, [FREE_SD if number else HELD_SD for number in range(len(cameras))])


def recording_of_links(linked: LinkedRig, body: Body) -> Recording:
    """What single pictures show, for an adjustment before anything is measured."""
    seen = [(k, d, d.time_s - i.time_s) for k, i in enumerate(linked.instants) for d in i.seen]
    return Recording(
        np.array([instant.time_s for instant in linked.instants]),
        RigidTransform.stack([instant.world_from_body for instant in linked.instants]),
        tracks_of(seen, body),
    )


def adjusted(cameras: tuple[Camera, ...], body: Body, recording: Recording) -> Refinement:
    """All cameras but the first freed, with their lenses as far as these have a covariance."""
    return refine_rig(cameras, body, recording, None, loose_prior(cameras))


def is_settled(before: tuple[Camera, ...], refinement: Refinement) -> bool:
    """Whether an adjustment moved the cameras by less than they are known to."""
    parts = []
    for old, now in zip(before, refinement.cameras, strict=True):
        parts.append(now.difference(old)[now.free])
    change = np.concatenate(parts)
    size = float(change @ np.linalg.solve(refinement.covariance, change)) / len(change)
    return size < _SETTLED_SDS**2


def moved_to(first: tuple[Camera, ...], now: tuple[Camera, ...]) -> tuple[Camera, ...]:
    """The first cameras, with what is known of their lenses, where they stand now."""
    return tuple(
        replace(camera, world_from_camera=other.world_from_camera)
        for camera, other in zip(first, now, strict=True)
    )


def freed_lenses(
    cameras: tuple[Camera, ...], body: Body, recording: Recording
) -> tuple[Camera, ...]:
    """The cameras with lenses as free as frame sets that are held out want them.

    Each half of the recording is tried on the other. Lenses that are not open stay as they are.
    """
    if not all(is_open(camera.intrinsics) for camera in cameras):
        return cameras
    best, least = cameras, np.inf
    for kind in LENS_KINDS:
        tried = tuple(with_lens_kind(camera, kind) for camera in cameras)
        halves = compare_halves(tried, body, recording, None, loose_prior(tried))
        missed = halves.held_out_px[1]
        if not missed < _BETTER * least:
            break
        best, least = tried, missed
    return best


@dataclass(frozen=True, eq=False)
class Shape:
    """Cameras with what is known of the rig's shape alone, and of its scale."""

    cameras: tuple[Camera, ...]
    joint: Floats  # (p, p) of all poses and free lens parameters
    scale_sd: float


def shape_of(refinement: Refinement, body: Body, recording: Recording) -> Shape:
    """The covariance without the world's place, turn and scale; and the scale's by itself.

    The scale is never better known than the body: by places of standard deviation s of balls at c
    it has the standard deviation s / sqrt(sum |c - mean c|^2).
    """
    cameras, points = refinement.cameras, ball_places(recording.world_from_body, body.centers)
    free = [camera.intrinsics.free for camera in cameras]
    P = refinement.covariance
    tolerance_mm = body.tolerance_mm or USUAL_RADIUS_TOLERANCE_MM
    stated = tolerance_mm / float(np.linalg.norm(body.centers - body.middle))
    shape, world, moves = shape_errors(cameras, free, points, with_scale=True)
    joint = shape @ P @ shape.T + (moves * _WORLD_SD**2) @ moves.T
    out = tuple(
        camera.with_covariance(joint[np.ix_(own, own)], lens, camera.reprojection_rms_px)
        for camera, own, lens in zip(cameras, columns_of(free), free, strict=True)
    )
    return Shape(out, joint, max(stated, float(np.sqrt(world[6] @ P @ world[6]))))

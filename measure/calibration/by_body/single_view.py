"""The body's pose by a single picture: centres of three balls, and the sizes of their outlines.

Three bearings leave up to four poses (Grunert 1841; Gao et al. 2003, "Complete solution
classification for the perspective-three-point problem"). The sizes of the outlines rule most of
them out, but a flat body and its mirror image through the plane across the line of sight look
nearly alike: both poses are kept, and other cameras and instants decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np

from measure.arrays import Floats, Ints
from measure.geometry import RigidTransform
from measure.model import Body, Detection, Intrinsics

_MOST_CANDIDATES = 3  # Of each ball in a picture, the surest
_SIZE_RATIO = 1.3  # Outlines of half-hidden balls are off by up to so much
REACH = 0.5  # Distance, in radii, up to which a sighting agrees with a place
_SAME_RADII = 0.25  # Poses that put the balls nearer together than this are one
_MOST_POSES, _RIVAL = 6, 0.75
"""Poses kept of a picture, and by how many sightings one may be less agreed on than the best."""
_LEAST_FORWARD = 0.1  # Cosine of the angle off the axis up to which bearings have image coordinates


@dataclass(frozen=True, eq=False)
class View:
    """What may be balls in one picture."""

    detections: tuple[Detection, ...]
    balls: Ints  # (n,) index of the ball that each may be
    axes: Floats  # (n, 3) unit bearings of the centres
    half_angles: Floats  # (n,) rad, of the cone about each ball

    @classmethod
    def of(cls, detections: Sequence[Detection], body: Body, lens: Intrinsics) -> View:
        """The surest detections of each ball, as bearings."""
        kept: list[Detection] = []
        for name in body.names:
            own = [d for d in detections if d.ball == name]
            kept += sorted(own, key=lambda d: -d.score)[:_MOST_CANDIDATES]
        balls = np.array([body.index(d.ball) for d in kept], dtype=np.int64)
        if not kept:
            return cls((), balls, np.zeros((0, 3)), np.zeros(0))
        around = np.arange(8) * (np.pi / 4)
        circle = np.column_stack([np.cos(around), np.sin(around)])
        centers = np.stack([d.center_px for d in kept])
        rims = centers[:, None] + np.array([d.radius_px for d in kept])[:, None, None] * circle
        axes = lens.unproject(centers)
        rays = lens.unproject(rims.reshape(-1, 2)).reshape(len(kept), -1, 3)
        off_axis = np.linalg.norm(np.cross(rays, axes[:, None]), axis=2)
        angles = np.arctan2(off_axis, np.einsum("nri,ni->nr", rays, axes)).mean(axis=1)
        seen = np.flatnonzero(np.isfinite(angles))
        return cls(tuple(kept[i] for i in seen), balls[seen], axes[seen], angles[seen])

    def agreement(self, places: Floats, radii: Floats) -> Floats:
        """How well each ball of bodies at `places` (..., k, 3) is seen, from 0 to 1: (..., k).

        Args:
            places: of all balls in the camera's frame, mm.
            radii: (k,) of the balls, mm.
        """
        out = np.zeros(places.shape[:-1])
        distances = np.linalg.norm(places, axis=-1)
        for ball in np.unique(self.balls):
            own = self.balls == ball
            far = np.maximum(distances[..., ball, None], radii[ball])
            # The squared chord between two unit vectors: the squared angle, where that is small.
            chord = 2 - 2 * (places[..., ball, :] @ self.axes[own].T) / far
            seen = 1 - chord / (REACH * self.half_angles[own]) ** 2
            size = radii[ball] / (far * np.sin(self.half_angles[own]))
            alike = (size < _SIZE_RATIO) & (size > 1 / _SIZE_RATIO)
            out[..., ball] = np.max(np.where(alike, np.maximum(seen, 0.0), 0.0), axis=-1)
        return out

    def agreeing(self, places: Floats, radii: Floats) -> list[Detection]:
        """Of each ball at `places` (k, 3) in the camera's frame, the sighting that agrees best."""
        out = []
        for ball in np.flatnonzero(self.agreement(places, radii)):
            own = np.flatnonzero(self.balls == ball)
            best = own[np.argmax(self.axes[own] @ places[ball])]
            out.append(self.detections[best])
        return out


def body_poses(view: View, body: Body) -> list[RigidTransform]:
    """The poses camera_from_body that a picture leaves, mirrored ones too; best agreed on first."""
    found: list[tuple[float, RigidTransform, Floats]] = []
    rows = [np.flatnonzero(view.balls == ball) for ball in range(len(body.balls))]
    for three in combinations(range(len(body.balls)), 3):
        for chosen in product(*(rows[ball] for ball in three)):
            for pose in resections(body.centers[list(three)], view.axes[list(chosen)]):
                places = pose.apply(body.centers)
                found.append((float(view.agreement(places, body.radii).sum()), pose, places))
    found.sort(key=lambda one: -one[0])
    kept: list[tuple[RigidTransform, Floats]] = []
    for agreed, pose, places in found:
        if agreed < max(3 - _RIVAL, found[0][0] - _RIVAL) or len(kept) == _MOST_POSES:
            break
        apart = [np.linalg.norm(places - other, axis=1).mean() for _, other in kept]
        if min(apart, default=np.inf) > _SAME_RADII * body.radii.mean():
            kept.append((pose, places))
    return [pose for pose, _ in kept]


def resections(points: Floats, axes: Floats) -> list[RigidTransform]:
    """The poses (up to four) from which three points (3, 3) lie at unit bearings (3, 3)."""
    if axes[:, 2].min() < _LEAST_FORWARD or np.max(axes @ axes.T - 2 * np.eye(3)) > 1 - 1e-6:
        return []
    flat = np.ascontiguousarray(axes[:, :2] / axes[:, 2:])
    _, turns, shifts = cv2.solveP3P(
        np.ascontiguousarray(points), flat, np.eye(3), None, flags=cv2.SOLVEPNP_AP3P
    )
    out = []
    for turn, shift in zip(turns or (), shifts or (), strict=True):
        pose = RigidTransform.from_rotvec(turn.ravel(), shift.ravel())
        if np.isfinite(pose.translation).all() and np.all(pose.apply(points)[:, 2] > 0):
            out.append(pose)
    return out

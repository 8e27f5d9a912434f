"""A rig linearised by all that may be unknown of it: bundle adjustment (Triggs et al. 2000).

Cameras see points, and each point is fixed to what carries it: a body or board as it lies at one
instant, or the world. Unknown may be parts of these blocks, by name:

- "camera NAME": pose and intrinsics (18,), see `Camera.perturb`;
- "points": their places in the axes of what carries them (3 k,), mm;
- "poses": of what carries them (6 f,), unless each is an instant's own;
- "offsets NAME": constant displacements (2 m,) in that camera's pictures, px;
- "clock NAME": what that camera's time stamps lack (1,), s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from measure.arrays import Floats, Ints
from measure.estimation.least_squares import Blocks, Group, Linearised, Prior
from measure.geometry import RigidTransform, chart_jacobian
from measure.model import Camera

Motion = Callable[[Ints, Ints, Floats], tuple[Floats, Floats]]
"""Ways and velocities (n, 3) of points, in the axes of what carries them, by the instant's number,
the point's, and how much later than that instant they are seen, s (n,)."""
_WIDEST_SINE = 0.9  # Of a ball's half-angle: nearer ones are nowhere


class Placed(NamedTuple):
    """Points in the world when their pictures were taken."""

    points: Floats  # (n, 3) mm
    arms: Floats  # (n, 3) from the origin of what carries them, in the world's axes
    turns: Floats  # (n, 3, 3) from the axes of what carries them to the world's
    speed: Floats  # (n, 3) mm/s


class SeenPoints(NamedTuple):
    """What one camera is expected to see of n points, and its derivatives.

    Of each point two coordinates in px; of balls also the logarithm of the apparent radius in px.
    """

    expected: Floats  # (n, r)
    by_camera: Floats  # (n, r, 18) see `Camera.perturb`
    by_pose: Floats  # (n, r, 6) of what carries the point, in its `perturb` chart
    by_point: Floats  # (n, r, 3) by its place in the axes of what carries it
    by_time: Floats  # (n, r, 1) per second


def linearise_view(camera: Camera, at: Placed, radii: Floats | None = None) -> SeenPoints:
    """Linearise a view of points, or of balls of `radii` (n,) mm."""
    expected, by_world, *by_parts = camera.project_with_jacobians(at.points)
    by_camera = np.concatenate(by_parts, axis=2)
    if radii is not None:
        # A ball's outline is as large as it is near, and as the lens enlarges its picture.
        away = at.points - camera.center
        nearer = -away / np.sum(away**2, axis=1)[:, None]
        size = np.log(_outline_px(by_world, radii, away))
        by_size = np.zeros((len(radii), 1, 18))
        by_size[:, 0, :3] = -nearer
        by_size[:, 0, 6:8] = 0.5 / np.diag(camera.intrinsics.matrix)[:2]
        expected = np.column_stack([expected, size])
        by_world = np.concatenate([by_world, nearer[:, None]], axis=1)
        by_camera = np.concatenate([by_camera, by_size], axis=1)
    return SeenPoints(
        expected,
        by_camera,
        by_world @ chart_jacobian(at.arms),
        by_world @ at.turns,
        by_world @ at.speed[:, :, None],
    )


def _outline_px(by_world: Floats, radii: Floats, away: Floats) -> Floats:
    """Mean radii (n,) of outlines of spheres so far `away` (n, 3); NaN for those without."""
    enlarged = np.linalg.svd(np.nan_to_num(by_world), compute_uv=False)[:, :2].mean(axis=1)
    sine = np.minimum(radii / np.linalg.norm(away, axis=1), _WIDEST_SINE)
    radius_px = enlarged * radii / np.sqrt(1 - sine**2)
    return np.where(radius_px > 0, radius_px, np.nan)


@dataclass(frozen=True, eq=False)
class Views:
    """What one camera saw of points."""

    camera: int  # its number
    pose: Ints  # (n,) which pose carries each
    point: Ints  # (n,) which point it is
    pixels: Floats  # (n, 2)
    # (n, 2, 2), or (2, 2) of all: R with R^T R the inverse of a pixel's covariance.
    root: Floats = field(default_factory=lambda: np.eye(2))
    offset: Ints | None = None  # (n,) which of the camera's offsets displaces each; None: none does
    lead_s: Floats | None = None  # (n,) how much later than its instant; None: at it


@dataclass(frozen=True, eq=False)
class RigState:
    """What is unknown."""

    cameras: tuple[Camera, ...]
    poses: RigidTransform  # (f,) of what carries the points, in the world
    # of the other blocks, by name: "points" (k, 3), "offsets NAME" (m, 2), "clock NAME" (1,).
    values: Blocks


@dataclass(frozen=True, eq=False)
class RigProblem:
    """Observations and priors, about a state from which it starts."""

    start: RigState  # also what the priors expect
    views: Sequence[Views]
    free: Mapping[str, Ints]  # which parameters are unknown of the blocks of these names
    # of some blocks, one after the other, R with R^T R the information about their free parameters.
    priors: Mapping[tuple[str, ...], Floats]
    own_poses: bool = False  # each pose is an instant's own, and eliminated
    motion: Motion | None = None  # of the points about their instants; None: at rest

    def linearise(self, state: RigState) -> Linearised:
        """Whitened residuals and derivatives at a state."""
        change = self.change(state)
        return Linearised(
            tuple(self._group(views, state) for views in self.views),
            {name: len(free) for name, free in self.free.items()},
            len(state.poses.translation) if self.own_poses else 0,
            tuple(
                Prior(names, root, -np.concatenate([change[name] for name in names]))
                for names, root in self.priors.items()
            ),
        )

    def change(self, state: RigState) -> dict[str, Floats]:
        """How far the free parameters are from the start, by block."""
        moved = {name: now - self.start.values[name] for name, now in state.values.items()}
        for old, now in zip(self.start.cameras, state.cameras, strict=True):
            moved[f"camera {now.name}"] = now.difference(old)
        if "poses" in self.free:
            moved["poses"] = state.poses.difference(self.start.poses)
        return {name: moved[name].reshape(-1)[free] for name, free in self.free.items()}

    def step(self, state: RigState, shared: Blocks, own: Floats) -> RigState:
        """The state after increments of the blocks, and of the instants' poses (f, 6)."""

        def whole(name: str, *shape: int) -> Floats:
            out = np.zeros(shape)
            if name in shared:
                out.reshape(-1)[self.free[name]] = shared[name]
            return out

        moved = own if self.own_poses else whole("poses", len(state.poses.translation), 6)
        return RigState(
            tuple(c.perturb(whole(f"camera {c.name}", 18)) for c in state.cameras),
            state.poses.perturb(moved),
            {name: value + whole(name, *value.shape) for name, value in state.values.items()},
        )

    def residuals_px(self, state: RigState) -> list[Floats]:
        """By view, what is left (n, 2) of its observations."""
        cameras, points = state.cameras, [self._placed(seen, state).points for seen in self.views]
        both = zip(self.views, points, strict=True)
        return [_left(seen, cameras[seen.camera].project(at), state) for seen, at in both]

    def _placed(self, views: Views, state: RigState) -> Placed:
        points, turns = state.values["points"][views.point], state.poses.rotation[views.pose]
        speed = np.zeros_like(points)
        if self.motion is not None and views.lead_s is not None:
            clock_s = state.values.get(f"clock {state.cameras[views.camera].name}", 0.0)
            way, speed = self.motion(views.pose, views.point, views.lead_s + clock_s)
            points, speed = points + way, np.einsum("nij,nj->ni", turns, speed)
        arms = np.einsum("nij,nj->ni", turns, points)
        return Placed(arms + state.poses.translation[views.pose], arms, turns, speed)

    def _group(self, views: Views, state: RigState) -> Group:
        camera, root, whole = state.cameras[views.camera], views.root, np.zeros_like(views.pose)
        seen = linearise_view(camera, self._placed(views, state))
        parts = {
            f"camera {camera.name}": (seen.by_camera, whole),
            "points": (seen.by_point, views.point),
            "poses": (seen.by_pose, views.pose),
            f"clock {camera.name}": (seen.by_time, whole),
        }
        if views.offset is not None:
            parts[f"offsets {camera.name}"] = np.tile(np.eye(2), (len(whole), 1, 1)), views.offset
        by_block = {}
        for name in [name for name in self.free if name in parts]:
            # Each row depends on the parameters of its own point, pose or offset alone.
            (by_own, own), free = parts[name], self.free[name]
            mine = own[:, None] == free // by_own.shape[2]
            if mine.any():
                by_free = by_own[:, :, free % by_own.shape[2]] * mine[:, None]
                by_block[name] = root @ by_free
        left = (root @ _left(views, seen.expected, state)[:, :, None])[:, :, 0]
        return Group(left, by_block, views.pose, root @ seen.by_pose)


def _left(views: Views, predicted: Floats, state: RigState) -> Floats:
    """Observed minus predicted pixels (n, 2)."""
    if views.offset is not None:
        name = state.cameras[views.camera].name
        predicted = predicted + state.values[f"offsets {name}"][views.offset]
    return views.pixels - predicted

"""Detections of an ideal detector with known noise, for tests of solvers without pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import Cone, RigidTransform, fit_cone, propagate, tangent_cone
from measure.model import Ball, Camera, Detection
from measure.simulation import kernels
from measure.simulation.renderer import Stage
from measure.simulation.scene import Scene, Shape

MIN_POINTS = 8


@dataclass(frozen=True)
class Observation:
    """Noise and sampling of observations.

    Attributes:
        noise_px: standard deviation of an outline point along its normal.
        points: outline points round a whole ball; hidden ones are left out.
        min_share: a ball of which less of the outline is seen is not reported.
    """

    noise_px: float = 0.1
    points: int = 64
    min_share: float = 0.3


def simulate_observations(
    scene: Scene, time_s: float, how: Observation | None = None, seed: int = 0
) -> list[Detection]:
    """Detections of every ball in every camera at one instant of a scene.

    Outlines are exact, with Gaussian noise along their normals; points that another shape hides, or
    that lie outside the picture, are left out. The centre and its covariance come from the cone
    fitted to the noisy outline, so they are consistent with it. Every camera sees the scene at its
    own time (`scene.phases_s`).

    Args:
        scene: what there is.
        time_s: nominal instant.
        how: noise and number of points.
        seed: of the noise.
    """
    how = how or Observation()
    rng = np.random.default_rng([seed, scene.seed])
    found = []
    for camera in scene.cameras:
        own_time = time_s + scene.phases_s.get(camera.name, 0.0)
        shapes, balls = _shapes_seen_by(scene, camera, own_time)
        for ball in balls:
            detection = _observe(camera, own_time, ball, shapes, scene, how, rng)
            if detection is not None:
                found.append(detection)
    return found


def _shapes_seen_by(scene: Scene, camera: Camera, time_s: float) -> tuple[list[Shape], list[Ball]]:
    """All shapes in the camera's frame, those of the body's balls first; and the balls shown."""
    balls = [b for b in scene.body.balls if scene.shown is None or b.name in scene.shown]
    shapes: list[Shape] = []
    for actor in scene.moving():
        camera_from_actor = camera.camera_from_world @ actor.trajectory.at(time_s)
        shapes += [shape.moved(camera_from_actor) for shape in actor.shapes]
    shapes += [shape.moved(camera.camera_from_world) for shape in scene.fixed]
    return shapes, balls


def _observe(
    camera: Camera,
    time_s: float,
    ball: Ball,
    shapes: list[Shape],
    scene: Scene,
    how: Observation,
    rng: np.random.Generator,
) -> Detection | None:
    world_from_body: RigidTransform = scene.trajectory.at(time_s)
    center = camera.camera_from_world.apply(world_from_body.apply(ball.center_mm))
    if center[2] <= ball.radius_mm:
        return None
    cone = tangent_cone(center, ball.radius_mm)
    bearings = cone.bearings(2 * np.pi * np.arange(how.points) / how.points)
    outline = camera.intrinsics.project(bearings)
    normals = _normals(outline)
    depth = (float(np.linalg.norm(center)) * np.cos(cone.half_angle)) * bearings[:, 2]
    noisy = outline + (how.noise_px * rng.standard_normal(how.points))[:, None] * normals
    others = [s for s in shapes if not np.allclose(s.anchor, center)]
    seen = camera.intrinsics.contains(outline) & _in_front(bearings, depth, others, scene)
    if np.count_nonzero(seen) < max(MIN_POINTS, how.min_share * how.points):
        return None
    try:
        fitted = fit_cone(camera.intrinsics.unproject(noisy[seen]))
    except DegenerateGeometryError:
        return None
    return _detection(camera, time_s, ball, fitted, noisy[seen], how)


def _detection(
    camera: Camera, time_s: float, ball: Ball, cone: Cone, outline: Floats, how: Observation
) -> Detection:
    pixels, by_point, _ = camera.intrinsics.project_with_jacobians(cone.axis[None])
    w = cone.axis / np.cos(cone.half_angle)
    # The centre's direction is that of w, and the covariance is that of w, from the stated noise.
    rays = camera.intrinsics.unproject(outline)
    spread = how.noise_px / camera.intrinsics.focal_px * float(np.sqrt(w @ w - 1))
    information = rays.T @ rays / max(spread, 1e-12) ** 2
    by_w = by_point[0] * np.cos(cone.half_angle)
    return Detection(
        ball=ball.name,
        camera=camera.name,
        time_s=time_s,
        center_px=pixels[0],
        radius_px=float(np.mean(np.linalg.norm(outline - pixels[0], axis=1))),
        covariance_px=propagate(by_w, np.asarray(np.linalg.inv(information), np.float64)),
        outline_px=outline,
        outline_sd_px=np.full(len(outline), how.noise_px),
    )


def _in_front(bearings: Floats, depth: Floats, others: list[Shape], scene: Scene) -> Bools:
    """Whether outline points (n,) at the given depths are not occluded."""
    if not others:
        return np.ones(len(bearings), bool)
    ideal = np.ascontiguousarray(bearings[:, :2] / bearings[:, 2:])
    near = np.ones((len(ideal), len(others)), bool)
    first, nearest = np.empty(len(ideal), np.int64), np.empty(len(ideal))
    stage = Stage(tuple(others), scene.lighting, 1.0)
    kernels.trace(ideal, near, 1, np.zeros(len(ideal)), stage.packed, first, nearest)
    return nearest > depth


def _normals(outline: Floats) -> Floats:
    """Unit normals (n, 2) of a closed outline (n, 2)."""
    along = np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)
    across = np.column_stack([along[:, 1], -along[:, 0]])
    return across / np.linalg.norm(across, axis=1, keepdims=True)

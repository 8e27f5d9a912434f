"""The kit's input to plugins: one instant of a simulated scene, with its exact truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from measure.geometry import RigidTransform, tangent_cone
from measure.model import BallPosition, Body, Camera, Detection, Expectation, Image
from measure.simulation import Scene, Still, render
from measure.simulation.catalogue import plain_scene

POSE = RigidTransform.from_rotvec([0.25, -0.35, 0.5], [6.0, -4.0, 255.0])
"""Where the body is: turned so that every ball is wholly visible in `CLEAR_VIEW`."""

CLEAR_VIEW = "cam2"
"""In the other cameras' pictures a ball hides part of another."""


@dataclass(frozen=True, eq=False)
class Example:
    """A body seen by four cameras."""

    scene: Scene  # what is simulated; its body stands still
    world_from_body: RigidTransform  # the truth
    time_s: float = 1.25  # the instant

    @property
    def body(self) -> Body:
        """The measured body."""
        return self.scene.body

    @property
    def cameras(self) -> dict[str, Camera]:
        """The cameras, by name."""
        return {camera.name: camera for camera in self.scene.cameras}

    @property
    def centers(self) -> Mapping[str, np.ndarray]:
        """True centre (3,) of every ball in the world, mm."""
        places = self.world_from_body.apply(self.body.centers)
        return dict(zip(self.body.names, places, strict=True))

    def image(self, camera: str) -> Image:
        """A fresh picture of one camera, as a session would deliver it."""
        pixels = _picture(self.scene, camera, self.time_s).copy()
        return Image(camera, 7, self.time_s, lambda: pixels)

    def true_center_px(self, camera: str, ball: str) -> np.ndarray:
        """Where the ball's centre is in the picture (2,)."""
        return self.cameras[camera].project(self.centers[ball][None])[0]

    def true_radius_px(self, camera: str, ball: str) -> float:
        """Mean radius of the ball's outline in the picture."""
        outline = self.cameras[camera].outline(self.centers[ball], self._radius(ball))
        return float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean())

    def expectation(
        self, camera: str, ball: str, off_px: tuple[float, float] = (0.0, 0.0)
    ) -> Expectation:
        """What tracking would expect, wrong by `off_px`."""
        radius = self.true_radius_px(camera, ball)
        return Expectation(
            ball=ball,
            center_px=self.true_center_px(camera, ball) + off_px,
            radius_px=(0.85 * radius, 1.15 * radius),
            min_distance_px=0.8 * radius,
            reach_px=12.0,
        )

    def detections(self, rng: np.random.Generator, sd_px: float = 0.05) -> list[Detection]:
        """Detections of all balls in all cameras as of an ideal detector, with noise of `sd_px`.

        The outline points scatter along their normals, the centres in every direction.
        """
        return [
            self._detection(camera, ball.name, rng, sd_px)
            for camera in self.scene.cameras
            for ball in self.body.balls
        ]

    def positions(self, rng: np.random.Generator, sd_mm: float = 0.05) -> list[BallPosition]:
        """Positions of all balls as of an ideal triangulator, with noise of `sd_mm` per axis."""
        return [
            BallPosition(
                ball=name,
                time_s=self.time_s,
                center=center + rng.normal(scale=sd_mm, size=3),
                covariance=sd_mm**2 * np.eye(3),
                cameras=tuple(self.cameras),
                residuals_mm=np.full(len(self.cameras), sd_mm),
            )
            for name, center in self.centers.items()
        ]

    def _detection(
        self, camera: Camera, ball: str, rng: np.random.Generator, sd_px: float
    ) -> Detection:
        cone = tangent_cone(camera.camera_from_world.apply(self.centers[ball]), self._radius(ball))
        outline = camera.intrinsics.outline(cone, 48)
        outward = outline - outline.mean(axis=0)
        radii = np.linalg.norm(outward, axis=1, keepdims=True)
        noise = rng.normal(scale=sd_px, size=(len(outline), 1))
        return Detection(
            ball=ball,
            camera=camera.name,
            time_s=self.time_s,
            center_px=camera.project(self.centers[ball][None])[0] + rng.normal(scale=sd_px, size=2),
            radius_px=float(radii.mean()),
            covariance_px=sd_px**2 * np.eye(2),
            color_match=1.0,
            outline_px=outline + noise * outward / radii,
            outline_sd_px=np.full(len(outline), sd_px),
        )

    def _radius(self, ball: str) -> float:
        return self.body.balls[self.body.index(ball)].radius_mm


@cache
def example(background: str = "black", balls: bool = True) -> Example:
    """The kit's scene: the paper's body, four webcams, soft light, noise of two levels.

    Args:
        background: "black" or "grey".
        balls: whether the balls are there; without them all else is the same.
    """
    scene = replace(plain_scene(background), trajectory=Still(POSE), shown=None if balls else ())
    return Example(scene, POSE)


@cache
def _picture(scene: Scene, camera: str, time_s: float) -> np.ndarray:
    return render(scene, camera, time_s)

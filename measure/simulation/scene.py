"""A scene: shapes, materials, light, cameras, and how they move, exactly at any time.

Rays are intersected with shapes in `kernels`, where the formulas that join light and materials
stand as well. Irradiance is scaled so that a white matt surface under an irradiance of 1 has a
radiance of 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, Ints
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.limits import TINY
from measure.model import Body, Camera
from measure.simulation.sensor import CameraSensor

_TERMS = 4  # sines in a random motion


class ContinuousTrajectory(Protocol):
    """A pose as a function of time."""

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        ...


@dataclass(frozen=True, eq=False)
class Still:
    """A body that does not move."""

    world_from_body: RigidTransform

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        shape = np.shape(times_s)
        return RigidTransform(
            np.broadcast_to(self.world_from_body.rotation, (*shape, 3, 3)),
            np.broadcast_to(self.world_from_body.translation, (*shape, 3)),
        )


@dataclass(frozen=True, eq=False)
class Sines:
    """A smooth trajectory: every coordinate is a sum of sines."""

    middle: RigidTransform  # pose about which the body moves
    amplitudes: Floats  # (k, 6) mm and rad, of x y z and the rotation vector
    frequencies_hz: Floats  # (k, 6)
    phases: Floats  # (k, 6) in rad

    def at(self, times_s: ArrayLike) -> RigidTransform:
        """world_from_body at times (...), a batch of the same shape."""
        times = np.asarray(times_s, dtype=np.float64)[..., None, None]
        turn = 2 * np.pi * self.frequencies_hz * times + self.phases
        delta = np.sum(self.amplitudes * np.sin(turn), axis=-2)
        # SciPy composes a single rotation by other code than a batch. Always a batch, so that the
        # pose at a time does not depend on the other times of the call.
        poses = self.middle.perturb(np.atleast_2d(delta))
        return poses if delta.ndim > 1 else poses[0]


@dataclass(frozen=True)
class MotionLimits:
    """Bounds of `random_motion`."""

    # largest distance from the middle along x, y and z.
    reach_mm: tuple[float, float, float] = (50.0, 50.0, 30.0)
    angle_rad: float = field(default=np.deg2rad(60.0))  # largest rotation from the middle
    speed_mm_s: float = 60.0  # largest speed of the body's origin
    turn_rad_s: float = 1.0  # largest angular speed
    slowest_hz: float = 0.05  # lowest frequency of the sines
    fastest_hz: float = 0.5  # highest frequency of the sines


def random_motion(seed: int, middle: RigidTransform, limits: MotionLimits | None = None) -> Sines:
    """A smooth random motion about `middle` that never exceeds `limits`.

    The bounds are those of the sums of amplitudes, so they hold at all times.
    """
    limits = limits or MotionLimits()
    rng = np.random.default_rng(seed)
    frequencies = rng.uniform(limits.slowest_hz, limits.fastest_hz, (_TERMS, 6))
    amplitudes = rng.uniform(0.3, 1.0, frequencies.shape) / frequencies
    amplitudes /= amplitudes.sum(axis=0)
    amplitudes[:, :3] *= limits.reach_mm
    amplitudes[:, 3:] *= limits.angle_rad / np.sqrt(3)
    peaks = np.sum(2 * np.pi * frequencies * amplitudes, axis=0)
    # Lower frequencies lower the speed and keep the reach.
    slower = max(
        float(np.linalg.norm(peaks[:3])) / limits.speed_mm_s,
        float(np.linalg.norm(peaks[3:])) / limits.turn_rad_s,
        1.0,
    )
    phases = rng.uniform(0, 2 * np.pi, frequencies.shape)
    return Sines(middle, amplitudes, frequencies / slower, phases)


Rgb = tuple[float, float, float]
Texture: TypeAlias = Callable[[Floats], Floats]


@dataclass(frozen=True, eq=False)
class Material:
    """A surface."""

    albedo_rgb: Rgb  # diffuse reflectance, linear, 0 to 1
    # mirror reflectance at normal incidence (0.04 for plastic; 0 is ideally matt).
    reflectance: float = 0.0
    # standard deviation, per axis, of the slopes of the microfacets: highlights and mirror images
    # are blurred by twice that.
    roughness_rad: float = 0.05
    # albedo (n, 3) of points (n, 3) in the frame of a `Cuboid`, instead of `albedo_rgb`.
    texture: Texture | None = None


@dataclass(frozen=True, eq=False)
class Lamp:
    """A round lamp."""

    position_mm: Floats  # (3,) in the world
    # at a distance of one metre; falls with the square of the distance.
    irradiance_rgb: Rgb = (1.0, 1.0, 1.0)
    radius_mm: float = 80.0  # radius of its disc; it softens shading, highlight and shadow


class Mirror(Protocol):
    """What the glossy shapes of a stage mirror beside the lamps."""

    def radiance(self, points: Any, numbers: Ints, per_pixel: int) -> Floats:
        """Radiance (n, 3) that surface points (n,) mirror to their viewers, B G R.

        Args:
            points: the `Points`.
            numbers: (n,) index of each point in its pixel.
            per_pixel: rays through a pixel.
        """


@dataclass(frozen=True, eq=False)
class Lighting:
    """The light of a scene."""

    lights: tuple[Lamp, ...]
    # diffuse light from all sides, from above; less comes from below.
    ambient_rgb: Rgb = (0.25, 0.25, 0.25)
    # radiance from straight above that a `mirror` shows where no shape is; it falls gradually to 0
    # at the horizon.
    surround_rgb: Rgb = (0.12, 0.12, 0.12)
    below: float = 0.3  # share of `ambient_rgb` that comes from below
    shadows: bool = False  # whether balls darken each other and what stands behind them
    # makes what glossy shapes mirror beside the lamps, of a stage's rows of shapes, lights,
    # reflectance by shape and place, and part of an exposure; None: what is behind, blurred.
    mirror: Callable[..., Mirror] | None = None
    # (3,) unit vector, away from the floor.
    up: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def seen_from(self, camera_from_world: RigidTransform) -> Lighting:
        """The same light in a camera's frame."""
        lamps = tuple(
            replace(lamp, position_mm=camera_from_world.apply(lamp.position_mm))
            for lamp in self.lights
        )
        return replace(self, lights=lamps, up=camera_from_world.rotate(self.up))


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: centre (3,) and radius in mm."""

    center_mm: Floats
    radius_mm: float
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Sphere:
        """The same ball in another frame."""
        return replace(self, center_mm=target_from_source.apply(self.center_mm))

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return np.asarray(self.center_mm, dtype=np.float64)

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        along = directions @ self.anchor / np.linalg.norm(directions, axis=1)
        across = np.sqrt(np.maximum(self.anchor @ self.anchor - along**2, 0))
        return _as_angle(across - self.radius_mm, along)


@dataclass(frozen=True, eq=False)
class Capsule:
    """A rod with round ends: axis from `start_mm` to `end_mm` (3,), radius in mm."""

    start_mm: Floats
    end_mm: Floats
    radius_mm: float
    material: Material

    def moved(self, target_from_source: RigidTransform) -> Capsule:
        """The same rod in another frame."""
        ends = target_from_source.apply(np.stack([self.start_mm, self.end_mm]))
        return replace(self, start_mm=ends[0], end_mm=ends[1])

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return (np.asarray(self.start_mm, dtype=np.float64) + self.end_mm) / 2

    def clearance(self, directions: Floats) -> Floats:
        """Angles (n,) in rad by which rays pass the silhouette; negative inside."""
        start = np.asarray(self.start_mm)
        axis = self.end_mm - start
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        # The point of the axis nearest to each line, kept between the ends.
        cosine = unit @ axis
        share = (unit @ start * cosine - start @ axis) / np.maximum(axis @ axis - cosine**2, TINY)
        near = start + np.clip(share, 0, 1)[:, None] * axis
        along = np.einsum("ij,ij->i", unit, near)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", near, near) - along**2, 0))
        return _as_angle(across - self.radius_mm, along)


@dataclass(frozen=True, eq=False)
class Cuboid:
    """A cuboid; flat ones serve as boards, posters, walls and floors."""

    frame_from_box: RigidTransform  # pose; the cuboid is centred in its own frame
    size_mm: tuple[float, float, float]  # (3,) full edge lengths
    material: Material  # its texture, if any, is evaluated in the box's frame

    def moved(self, target_from_source: RigidTransform) -> Cuboid:
        """The same cuboid in another frame."""
        return replace(self, frame_from_box=target_from_source @ self.frame_from_box)

    @property
    def anchor(self) -> Floats:
        """The point (3,) whose motion stands for the shape's."""
        return self.frame_from_box.translation

    def clearance(self, directions: Floats) -> Floats:
        """As for a ball, of the bounding ball; -1 everywhere if the camera is inside it."""
        ball = Sphere(self.anchor, float(np.linalg.norm(self.size_mm)) / 2, self.material)
        if np.linalg.norm(self.anchor) <= ball.radius_mm:
            return np.full(len(directions), -1.0)
        return ball.clearance(directions)

    def local(self, points: Floats) -> Floats:
        """Points (n, 3) in the cuboid's own frame."""
        return (points - self.anchor) @ self.frame_from_box.rotation


Shape: TypeAlias = Sphere | Capsule | Cuboid


def _as_angle(gap_mm: Floats, along_mm: Floats) -> Floats:
    """Angles (n,) in rad of distances beside a ray, seen from its origin; inf behind it."""
    return np.where(along_mm > 0, gap_mm / np.maximum(along_mm, TINY), np.inf)


BALL_ALBEDO: dict[str, Rgb] = {
    "red": (0.45, 0.012, 0.02),
    "orange": (0.70, 0.20, 0.012),
    "yellow": (0.72, 0.42, 0.012),
    "green": (0.015, 0.22, 0.045),
    "cyan": (0.02, 0.42, 0.45),
    "blue": (0.015, 0.07, 0.42),
    "purple": (0.16, 0.03, 0.34),
    "magenta": (0.45, 0.03, 0.25),
    "pink": (0.65, 0.22, 0.35),
    "white": (0.80, 0.80, 0.78),
    "black": (0.015, 0.015, 0.015),
}
"""Linear reflectance of plastic of the common colours."""


@dataclass(frozen=True, eq=False)
class Actor:
    """Shapes that move together."""

    shapes: tuple[Shape, ...]  # in the actor's own frame
    trajectory: ContinuousTrajectory  # world_from_actor at any time


@dataclass(frozen=True, eq=False)
class Scene:
    """All that a rendered picture depends on."""

    name: str  # of the scene, and of the session written from it
    body: Body  # the measured body; its balls are drawn
    cameras: tuple[Camera, ...]  # with their true calibration
    trajectory: ContinuousTrajectory
    lighting: Lighting
    # material of the balls; its albedo is replaced by the colour of each ball.
    finish: Material = field(default_factory=lambda: Material((1.0, 1.0, 1.0), 0.04))
    attached: tuple[Shape, ...] = ()  # stems and shafts that move with the body, in its frame
    actors: tuple[Actor, ...] = ()
    fixed: tuple[Shape, ...] = ()  # shapes that do not move; they occlude and are occluded
    backdrop: tuple[Shape, ...] = ()  # walls, floor and posters, behind all other shapes
    backdrop_px: int = 4  # the backdrop is computed at every n-th pixel and interpolated between
    # from radiance to image file, for all cameras.
    sensor: CameraSensor = field(default_factory=CameraSensor)
    # by camera name, the sensors that differ from `sensor`.
    sensors: dict[str, CameraSensor] = field(default_factory=dict)
    # by camera name, delay of its exposures in s.
    phases_s: dict[str, float] = field(default_factory=dict)
    seed: int = 0
    shown: tuple[str, ...] | None = None  # names of the balls that are drawn; None for all
    # cameras written to the calibration file, if not the true ones.
    stated_cameras: tuple[Camera, ...] | None = None
    stated_body: Body | None = None  # body written to the body file, if not the true one
    description: str = "simulated; exact truth"

    def camera(self, name: str) -> Camera:
        """The camera called `name`; ConfigError if there is none."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        names = ", ".join(camera.name for camera in self.cameras)
        raise ConfigError(f"scene '{self.name}' has no camera '{name}'; it has {names}")

    def sensor_of(self, name: str) -> CameraSensor:
        """The sensor of the camera called `name`."""
        return self.sensors.get(name, self.sensor)

    def moving(self) -> tuple[Actor, ...]:
        """Everything that moves, the measured body first."""
        balls = ball_shapes(self.body, self.finish, self.shown)
        return (Actor((*balls, *self.attached), self.trajectory), *self.actors)


def ball_shapes(
    body: Body, finish: Material, shown: tuple[str, ...] | None = None
) -> tuple[Sphere, ...]:
    """The balls of a body (those named in `shown`, or all), in its frame, in its colours."""
    return tuple(
        Sphere(ball.center_mm, ball.radius_mm, painted(finish, ball.color.name))
        for ball in body.balls
        if shown is None or ball.name in shown
    )


def painted(finish: Material, color: str) -> Material:
    """A material in one of the common colours; grey where the colour has no common name."""
    return Material(
        BALL_ALBEDO.get(color, (0.4, 0.4, 0.4)), finish.reflectance, finish.roughness_rad
    )

"""A scene: moving and standing shapes, cameras and light."""

from __future__ import annotations

from dataclasses import dataclass, field

from measure.errors import ConfigError
from measure.model import Body, Camera
from measure.simulation.sensor import CameraSensor
from measure.simulation.shading import Lighting, Material, Rgb
from measure.simulation.shapes import Shape, Sphere
from measure.simulation.trajectory import ContinuousTrajectory

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

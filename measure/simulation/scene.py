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
    """Shapes that move together.

    Attributes:
        shapes: in the actor's own frame.
        trajectory: world_from_actor at any time.
    """

    shapes: tuple[Shape, ...]
    trajectory: ContinuousTrajectory


@dataclass(frozen=True, eq=False)
class Scene:
    """All that a rendered picture depends on.

    Attributes:
        name: of the scene, and of the session written from it.
        body: the measured body; its balls are drawn.
        cameras: with their true calibration.
        finish: material of the balls; its albedo is replaced by the colour of each ball.
        attached: stems and shafts that move with the body, in its frame.
        fixed: shapes that do not move; they occlude and are occluded.
        backdrop: walls, floor and posters, behind all other shapes.
        backdrop_px: the backdrop is computed at every n-th pixel and interpolated between.
        sensor: from radiance to image file, for all cameras.
        sensors: by camera name, the sensors that differ from `sensor`.
        phases_s: by camera name, delay of its exposures in s.
        shown: names of the balls that are drawn; None for all.
        stated_cameras: cameras written to the calibration file, if not the true ones.
        stated_body: body written to the body file, if not the true one.
    """

    name: str
    body: Body
    cameras: tuple[Camera, ...]
    trajectory: ContinuousTrajectory
    lighting: Lighting
    finish: Material = field(default_factory=lambda: Material((1.0, 1.0, 1.0), 0.04))
    attached: tuple[Shape, ...] = ()
    actors: tuple[Actor, ...] = ()
    fixed: tuple[Shape, ...] = ()
    backdrop: tuple[Shape, ...] = ()
    backdrop_px: int = 4
    sensor: CameraSensor = field(default_factory=CameraSensor)
    sensors: dict[str, CameraSensor] = field(default_factory=dict)
    phases_s: dict[str, float] = field(default_factory=dict)
    seed: int = 0
    shown: tuple[str, ...] | None = None
    stated_cameras: tuple[Camera, ...] | None = None
    stated_body: Body | None = None
    description: str = "simulated; exact truth"

    def camera(self, name: str) -> Camera:
        """The camera called `name`.

        Raises:
            ConfigError: there is none.
        """
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

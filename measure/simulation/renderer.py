"""The pictures of one camera of a scene."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.model import Camera
from measure.simulation.canvas import Canvas, reduced
from measure.simulation.caster import Stage
from measure.simulation.scene import Scene, Shape
from measure.simulation.sensor import Linear, develop

SAMPLES = 89  # Rays through a pixel that an edge crosses
_FEWEST_SAMPLES = 16
_STEP_PX = 0.35
"""Motion in px between the instants averaged over an exposure (at most `_MOST_STEPS`)."""
_MOST_STEPS = 16
_VELOCITY_STEP_S = 1e-4


class Renderer:
    """Renders one camera; what stands still once. `samples` are rays through an edge pixel."""

    def __init__(self, scene: Scene, camera: str, samples: int = SAMPLES) -> None:
        self.scene = scene
        self.samples = samples
        self.camera = scene.camera(camera)
        self.sensor = scene.sensor_of(camera)
        self._index = [c.name for c in scene.cameras].index(camera)
        self._lighting = scene.lighting.seen_from(self.camera.camera_from_world)
        self._focal_px = self.camera.intrinsics.focal_px
        self._fisheye = self.camera.intrinsics.model == "fisheye"

    def picture(self, time_s: float, frame: int = 0) -> Bytes:
        """The 8-bit picture (h, w, 3), B G R, whose exposure is centred on `time_s`.

        The noise depends on the scene's seed, the camera and `frame`, and on nothing else.
        """
        rng = np.random.Generator(np.random.SFC64([self.scene.seed, self._index, frame]))
        return develop(self.radiance(time_s), self.sensor, rng)

    def radiance(self, time_s: float) -> Linear:
        """Linear radiance (h, w, 3), B G R, averaged over pixels and exposure."""
        steps = self._exposure_steps(time_s)
        total: Linear | None = None
        for k in range(steps):
            instant = time_s + self.sensor.exposure_s * ((k + 0.5) / steps - 0.5)
            drawn = self._instant(instant, k, steps)
            total = drawn if total is None else np.add(total, drawn, out=total)
        assert total is not None
        return total if steps == 1 else total / np.float32(steps)

    def _exposure_steps(self, time_s: float) -> int:
        if self.sensor.exposure_s <= 0:
            return 1
        shapes, velocities = self._moving_shapes(time_s)
        if not shapes:
            return 1
        away = np.array([np.linalg.norm(shape.anchor) for shape in shapes])
        swept = np.linalg.norm(velocities, axis=1) / away * self.sensor.exposure_s * self._focal_px
        return int(np.clip(np.ceil(swept.max() / _STEP_PX), 1, _MOST_STEPS))

    def _instant(self, time_s: float, step: int, steps: int) -> Linear:
        """Radiance at one of the instants that a picture is averaged over."""
        moving, velocities = self._moving_shapes(time_s)
        fixed = self._fixed
        rows = self._canvas.height * self.sensor.row_time_s
        stage = Stage(
            (*moving, *fixed),
            self._lighting,
            self._focal_px,
            np.vstack([velocities, np.zeros((len(fixed), 3))]) if rows else None,
            rows / 2,
            self._walls,
            self._behind,
            (step, steps),
            self._fisheye,
        )
        samples = max(self.samples // steps, _FEWEST_SAMPLES)
        return self._canvas.draw(stage, len(moving), samples, self._backdrop, self._still_picture)

    def _moving_shapes(self, time_s: float) -> tuple[list[Shape], Floats]:
        """All moving shapes in the camera's frame, and the velocities (k, 3) of their anchors."""
        shapes: list[Shape] = []
        velocities = []
        times = np.array([time_s, time_s - _VELOCITY_STEP_S, time_s + _VELOCITY_STEP_S])
        for actor in self.scene.moving():
            poses = self.camera.camera_from_world @ actor.trajectory.at(times)
            for shape in actor.shapes:
                now, before, after = (shape.moved(poses[i]) for i in range(3))
                shapes.append(now)
                velocities.append((after.anchor - before.anchor) / (2 * _VELOCITY_STEP_S))
        return shapes, np.reshape(velocities, (-1, 3))

    @cached_property
    def _canvas(self) -> Canvas:
        return Canvas(self.camera.intrinsics, self.sensor.row_time_s)

    @cached_property
    def _fixed(self) -> tuple[Shape, ...]:
        return tuple(s.moved(self.camera.camera_from_world) for s in self.scene.fixed)

    @cached_property
    def _walls(self) -> tuple[Shape, ...]:
        return tuple(s.moved(self.camera.camera_from_world) for s in self.scene.backdrop)

    @cached_property
    def _backdrop(self) -> Linear:
        """The picture of walls, floor and posters alone, drawn coarsely and enlarged."""
        lens = reduced(self.camera.intrinsics, self.scene.backdrop_px)
        coarse = Canvas(lens)
        stage = Stage(self._walls, self._lighting, lens.focal_px, fisheye=self._fisheye)
        nothing = coarse.empty()
        drawn = coarse.draw(stage, len(self._walls), _FEWEST_SAMPLES, nothing, nothing)
        size = self.camera.intrinsics.size_wh
        return np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_LINEAR), np.float32)

    @cached_property
    def _behind(self) -> Floats:
        """Mean radiance (3,) of the backdrop, B G R: an outline mirrors what is behind it."""
        return self._backdrop.mean(axis=(0, 1), dtype=np.float64)

    @cached_property
    def _still_picture(self) -> Linear:
        """The picture of all shapes that do not move."""
        if not self._fixed:
            return self._backdrop
        stage = Stage(
            self._fixed,
            self._lighting,
            self._focal_px,
            backdrop=self._walls,
            behind=self._behind,
            fisheye=self._fisheye,
        )
        return self._canvas.draw(
            stage, len(self._fixed), self.samples, self._backdrop, self._backdrop
        )


def render(scene: Scene, camera: Camera | str, time_s: float, frame: int = 0) -> Bytes:
    """One picture (h, w, 3), B G R. For several of one camera, keep a `Renderer`: it is faster.

    Args:
        camera: one of the scene's cameras, or its name.
        time_s: middle of the exposure.
        frame: number of the picture; chooses the noise.
    """
    name = camera if isinstance(camera, str) else camera.name
    return Renderer(scene, name).picture(time_s, frame)

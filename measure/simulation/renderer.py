"""The pictures of one camera of a scene: which rays are cast, and what light they meet."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.errors import ConfigError
from measure.limits import AT_ONCE
from measure.model import Camera, Intrinsics
from measure.simulation import kernels
from measure.simulation.kernels import (
    LAMP_ROW,
    NOTHING,
    REUSE,
    Lights,
    RayHits,
    choose_lit,
    mean_of_pixels,
    meet,
    no_points,
    reflect,
)
from measure.simulation.scene import (
    Capsule,
    Cuboid,
    Lighting,
    Mirror,
    Scene,
    Shape,
    Sphere,
    Texture,
)
from measure.simulation.sensor import Linear, develop

_VELOCITY = slice(kernels.VELOCITY, kernels.VELOCITY + 3)
_GOLDEN = (math.sqrt(5) - 1) / 2
_EDGE_PX = 0.75  # An outline crosses a pixel only if it passes the centre at a smaller distance


@dataclass(frozen=True, eq=False)
class Stage:
    """Shapes and light, in a camera's frame."""

    shapes: tuple[Shape, ...]  # in the camera's frame
    lighting: Lighting  # in the camera's frame
    focal_px: float  # focal length of the camera, px per rad on its axis
    # (k, 3) mm/s of the shapes, for a rolling shutter; None if all stand still.
    velocities: Floats | None = None
    # largest difference between the exposure of a row and the middle row.
    longest_delay_s: float = 0.0
    # standing shapes that are drawn apart; a `mirror` shows them too.
    backdrop: tuple[Shape, ...] = ()
    # (3,) B G R, their mean radiance, which glossy shapes mirror if there is no `mirror`.
    behind: Floats = field(default_factory=lambda: np.zeros(3))
    # (index, count) of the stages that are averaged over an exposure.
    part: tuple[int, int] = (0, 1)
    fisheye: bool = False

    def colours(self, ideal: Floats, near: Bools, delays_s: Floats) -> tuple[Floats, Ints]:
        """Radiance that rays see.

        Args:
            ideal: (m, s, 2) undistorted normalised image coordinates of s rays through m pixels.
            near: (k, m) which shapes the rays of a pixel can meet.
            delays_s: (m,) time of exposure in s after that of the shapes' poses.

        Returns:
            Mean linear radiance (m, 3) of a pixel's rays, B G R, 0 for a ray that meets no shape;
            and the shapes met (m, s), `NOTHING` for none.
        """
        pixels, rays = ideal.shape[:2]
        flat = np.ascontiguousarray(ideal.reshape(-1, 2))
        first, depth = np.empty(len(flat), np.int64), np.empty(len(flat))
        rows = np.ascontiguousarray(near.T)
        kernels.trace(flat, rows, rays, delays_s, self.packed, first, depth)
        met, out = RayHits(flat, rays, delays_s, first, depth), np.empty((pixels, 3))
        light, source = self._light(met)
        albedo, by_ray = self._seen_albedo(met)
        mean_of_pixels(met, source, light, albedo, by_ray, out)
        return out, first.reshape(pixels, rays)

    def gaps_px(self, k: int, ideal: Floats) -> Floats:
        """Distances (n,) in px of rays (n, 2) from the silhouette of shape k; negative inside."""
        directions = np.column_stack([ideal, np.ones(len(ideal))])
        length2 = np.einsum("ij,ij->i", directions, directions)
        # One radian is f px on the axis, and off it at most f / cos^2, or about f of a fisheye.
        scale = self.focal_px if self.fisheye else self.focal_px * length2
        return self.shapes[k].clearance(directions) * scale

    def silhouettes(self, ideal: Floats, near: Bools) -> Bools:
        """Whether the outline of a round shape crosses the pixel of each ray (n, 2)."""
        found = np.zeros(len(ideal), bool)
        for k, shape in enumerate(self.shapes):
            if isinstance(shape, Cuboid):
                continue
            rows = np.flatnonzero(near[k])
            found[rows] |= np.abs(self.gaps_px(k, ideal[rows])) < _EDGE_PX + self.smear_px(k)
        return found

    def smear_px(self, k: int) -> float:
        """Largest shift in px of shape k's outline by the rolling shutter."""
        if self.velocities is None or self.longest_delay_s == 0:
            return 0.0
        speed = np.linalg.norm(self.velocities[k]) / np.linalg.norm(self.shapes[k].anchor)
        return float(speed) * self.longest_delay_s * self.focal_px

    def _light(self, met: RayHits) -> tuple[Floats, Ints]:
        """Light (j, 6) as `reflect` gives it, and the row of it (n,) for each ray."""
        lit, source = np.empty((2, len(met.first)), np.int64)
        lit = lit[: choose_lit(met, len(self.shapes), lit, source)]
        points, light = no_points(len(lit)), np.empty((len(lit), 6))
        meet(met, lit, self.packed, points)
        mirrored = np.tile(self.behind, (len(lit), 1))
        if self._mirror is not None:
            mirrored = self._mirror.radiance(points, lit % met.per_pixel // REUSE, met.per_pixel)
        reflect(points, mirrored, self.packed, self._lights, light)
        return light, source

    def _seen_albedo(self, met: RayHits) -> tuple[Floats, bool]:
        """Reflectance, B G R, per shape (k, 3), or per ray (n, 3) where a texture may be seen."""
        if not any(k < len(self.shapes) for k, _, _ in self._textured):
            return self._plain_albedo, False
        depth = np.where(met.first == NOTHING, 0.0, met.depth)
        places = depth[:, None] * np.column_stack([met.ideal, np.ones(len(depth))])
        return self._albedo_of(met.first, places, np.repeat(met.delays_s, met.per_pixel)), True

    def _albedo_of(self, shape: Ints, places: Floats, delays_s: Floats) -> Floats:
        """Reflectance (n, 3), B G R, at places (n, 3) on shapes (n,); 0 on `NOTHING`."""
        out = np.where((shape == NOTHING)[:, None], 0.0, self._plain_albedo[shape])
        for k, box, texture in self._textured:
            rows = np.flatnonzero(shape == k)
            for begin in range(0, rows.size, AT_ONCE):
                part = rows[begin : begin + AT_ONCE]
                way = delays_s[part, None] * self.packed[k, _VELOCITY]
                out[part] = texture(box.local(places[part] - way))[:, ::-1]
        return out

    @cached_property
    def packed(self) -> Floats:
        """All shapes as rows of numbers (k, ROW), as the kernels read them; the backdrop's last."""
        rows = np.zeros((len(self._all), kernels.ROW))
        for row, shape in zip(rows, self._all, strict=True):
            _pack(row, shape)
        if self.velocities is not None:
            rows[: len(self.shapes), _VELOCITY] = self.velocities
        rows[len(self.shapes) :, kernels.BACKDROP] = 1.0
        return rows

    @cached_property
    def _lights(self) -> Lights:
        light = self.lighting
        lamps = [[*v.position_mm, *v.irradiance_rgb[::-1], v.radius_mm] for v in light.lights]
        return Lights(
            np.array(lamps, dtype=np.float64).reshape(-1, LAMP_ROW),
            np.array(light.ambient_rgb[::-1]),
            np.array(light.surround_rgb[::-1]),
            np.array([*light.up, light.below]),
            self._blockers(),
        )

    @cached_property
    def _mirror(self) -> Mirror | None:
        of = self.lighting.mirror
        return of and of(self.packed, self._lights, self._albedo_of, self.part)

    def _blockers(self) -> Ints:
        if not self.lighting.shadows:
            return np.zeros(0, np.int64)
        return np.flatnonzero([isinstance(shape, Sphere) for shape in self._all])

    @cached_property
    def _plain_albedo(self) -> Floats:
        """Reflectance (k, 3), B G R, of all shapes, textures apart."""
        return np.array([s.material.albedo_rgb[::-1] for s in self._all]).reshape(-1, 3)

    @cached_property
    def _textured(self) -> list[tuple[int, Cuboid, Texture]]:
        """All boxes that bear a texture."""
        return [
            (k, s, s.material.texture)
            for k, s in enumerate(self._all)
            if isinstance(s, Cuboid) and s.material.texture is not None
        ]

    @property
    def _all(self) -> tuple[Shape, ...]:
        return (*self.shapes, *self.backdrop)


def spread(count: int) -> Floats:
    """Offsets (count, 2) in px within a pixel: a lattice near the golden ratio, mean exactly 0.

    89 of them give the area beside a straight edge to 0.009 px RMS at any slant; every offset
    differs from all others in both coordinates, so edges along rows and columns do as well.
    """
    steps = range(1, max(count, 2))
    coprime = [a for a in steps if math.gcd(a, count) == 1]
    step = min(coprime, key=lambda a: abs(a - _GOLDEN * count))
    i = np.arange(count)
    return np.column_stack([i, i * step % count]) / count + (0.5 / count - 0.5)


def _pack(row: Floats, shape: Shape) -> None:
    """Fill a shape's row of numbers."""
    a, b = slice(kernels.A, kernels.A + 3), slice(kernels.B, kernels.B + 3)
    row[kernels.REFLECTANCE] = shape.material.reflectance
    row[kernels.ROUGHNESS] = shape.material.roughness_rad
    if isinstance(shape, Cuboid):
        row[kernels.KIND], row[a], row[b] = kernels.BOX, shape.anchor, np.array(shape.size_mm) / 2
        row[kernels.REACH] = np.linalg.norm(row[b])
        row[kernels.TURN : kernels.TURN + 9] = shape.frame_from_box.rotation.ravel()
        return
    row[kernels.RADIUS] = shape.radius_mm
    if isinstance(shape, Capsule):
        row[kernels.KIND], row[a], row[b] = kernels.CAPSULE, shape.start_mm, shape.end_mm
        row[kernels.REACH] = shape.radius_mm + np.linalg.norm(row[b] - row[a])
    else:
        row[kernels.KIND], row[a] = kernels.SPHERE, shape.center_mm
        row[kernels.REACH] = shape.radius_mm


Index: TypeAlias = tuple[slice, slice]
_BLOCK_PX = 8
_MIDDLE = _BLOCK_PX // 2 + 1  # index in the grid, which begins one pixel before the picture
_BLOCK_MARGIN_PX = 0.75 * _BLOCK_PX + 2.0
_TEXTURE_STEP = 0.05
"""Relative difference of neighbouring pixels on a flat face from which they are supersampled."""


class Canvas:
    """The pixel grid of one camera, with the ray of every pixel."""

    def __init__(self, intrinsics: Intrinsics, row_time_s: float = 0.0) -> None:
        self.width, self.height = intrinsics.size_wh
        self.row_time_s = row_time_s
        self._ideal = ideal_grid(intrinsics)
        self._block_shape = (-(-self.height // _BLOCK_PX), -(-self.width // _BLOCK_PX))
        rows = np.minimum(np.arange(self._block_shape[0]) * _BLOCK_PX + _MIDDLE, self.height)
        columns = np.minimum(np.arange(self._block_shape[1]) * _BLOCK_PX + _MIDDLE, self.width)
        self._block_ideal = self._ideal[np.ix_(rows, columns)].reshape(-1, 2)

    def empty(self) -> Linear:
        """A black picture (h, w, 3)."""
        return np.zeros((self.height, self.width, 3), np.float32)

    def draw(
        self, stage: Stage, redraw: int, samples: int, backdrop: Linear, before: Linear
    ) -> Linear:
        """Draw the pixels in which the first `redraw` shapes of a stage can be visible.

        Args:
            redraw: number of shapes that are not in `before` already.
            samples: rays through a pixel that an edge crosses.
            backdrop: (h, w, 3) radiance of rays that meet no shape.
            before: (h, w, 3) radiance of all other pixels.
        """
        out = before.copy()
        rows, columns, near = self._pixels_near(stage, redraw)
        if not rows.size:
            return out
        ideal, delays = self._ideal[rows + 1, columns + 1], self._delays(rows)
        seen, met = stage.colours(ideal[:, None], near, delays)
        first = met[:, 0]
        missed = first == NOTHING
        seen[missed] = backdrop[rows[missed], columns[missed]]
        out[rows, columns] = seen
        fine = stage.silhouettes(ideal, near) | self._steps(stage, rows, columns, first, seen)
        for part in np.array_split(np.flatnonzero(fine), np.count_nonzero(fine) // AT_ONCE + 1):
            r, c = rows[part], columns[part]
            out[r, c] = self._sample(stage, near[:, part], r, c, samples, backdrop)
        return out

    def _pixels_near(self, stage: Stage, redraw: int) -> tuple[Ints, Ints, Bools]:
        """Rows and columns (n,) of pixels to draw, and which shapes (k, n) are near each."""
        count = len(self._block_ideal)
        near = np.zeros((len(stage.shapes), count), bool)
        for k in range(len(stage.shapes)):
            gaps = stage.gaps_px(k, self._block_ideal)
            near[k] = gaps < _BLOCK_MARGIN_PX + stage.smear_px(k)
        blocks = np.flatnonzero(near[:redraw].any(axis=0))
        top, left = np.divmod(blocks, self._block_shape[1])
        inner = np.arange(_BLOCK_PX)
        shape = (len(blocks), _BLOCK_PX, _BLOCK_PX)
        rows = np.broadcast_to((top[:, None] * _BLOCK_PX + inner)[:, :, None], shape).ravel()
        columns = np.broadcast_to((left[:, None] * _BLOCK_PX + inner)[:, None, :], shape).ravel()
        inside = (rows < self.height) & (columns < self.width)
        near = np.repeat(near[:, blocks], _BLOCK_PX * _BLOCK_PX, axis=1)
        return rows[inside], columns[inside], near[:, inside]

    def _steps(self, stage: Stage, rows: Ints, columns: Ints, first: Ints, seen: Floats) -> Bools:
        """Pixels (n,) beside which another shape begins, or a flat face changes its colour."""
        top, left = int(rows.min()), int(columns.min())
        shape = (int(rows.max()) - top + 1, int(columns.max()) - left + 1)
        ids = np.full(shape, NOTHING - 1, np.int16)
        r, c = rows - top, columns - left
        ids[r, c] = first
        # Outlines of round shapes are found analytically (`silhouettes`); these are the borders
        # between shapes and the edges and textures of cuboids.
        flat = np.array([isinstance(s, Cuboid) for s in stage.shapes] + [False])
        lowest = NOTHING if flat[first].any() else 0
        step = _beside(
            lambda a, b: (ids[a] != ids[b]) & (np.minimum(ids[a], ids[b]) >= lowest), shape
        )
        if flat[first].any():
            grey = np.zeros(shape)
            grey[r, c] = seen.sum(axis=1) * flat[first]
            step |= _beside(
                lambda a, b: (
                    np.abs(grey[a] - grey[b]) > _TEXTURE_STEP * np.maximum(grey[a], grey[b])
                ),
                shape,
            )
        return step[r, c]

    def _sample(
        self, stage: Stage, near: Bools, rows: Ints, columns: Ints, samples: int, backdrop: Linear
    ) -> Floats:
        """Mean radiance (n, 3) over the area of pixels."""
        r, c = rows + 1, columns + 1
        by_column = (self._ideal[r, c + 1] - self._ideal[r, c - 1]) / 2
        by_row = (self._ideal[r + 1, c] - self._ideal[r - 1, c]) / 2
        offset = spread(samples)
        ideal = self._ideal[r, c][:, None] + (
            offset[:, :1] * by_column[:, None] + offset[:, 1:] * by_row[:, None]
        )
        seen, first = stage.colours(ideal, near, self._delays(rows))
        missed = np.mean(first == NOTHING, axis=1)
        return seen + missed[:, None] * backdrop[rows, columns]

    def _delays(self, rows: Ints) -> Floats:
        """Delays (n,) in s of the exposure of rows (n,) after the middle row."""
        return np.asarray((rows - (self.height - 1) / 2) * self.row_time_s, dtype=np.float64)


def ideal_grid(intrinsics: Intrinsics) -> Floats:
    """Undistorted normalised coordinates (h + 2, w + 2, 2) of all pixels and one beyond the border.

    The lens model is inverted at every eighth pixel and interpolated by bicubic splines, true to
    1e-6 px for ordinary lenses. ConfigError: the lens model has no inverse somewhere in the
    picture.
    """
    from scipy.interpolate import RectBivariateSpline

    width, height = intrinsics.size_wh
    u, v = _knots(width), _knots(height)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    bearings = intrinsics.unproject(uv)
    if not np.isfinite(bearings).all():
        raise ConfigError("the lens distortion cannot be inverted over the whole picture")
    ideal = (bearings[:, :2] / bearings[:, 2:]).reshape(len(v), len(u), 2)
    rows, columns = np.arange(-1, height + 1), np.arange(-1, width + 1)
    return np.stack(
        [RectBivariateSpline(v, u, ideal[..., k])(rows, columns) for k in range(2)], axis=-1
    )


def reduced(intrinsics: Intrinsics, factor: int) -> Intrinsics:
    """The same lens with pixels `factor` times as large."""
    width, height = intrinsics.size_wh
    matrix = intrinsics.matrix / factor
    matrix[:2, 2] -= (factor - 1) / (2 * factor)
    matrix[2, 2] = 1.0
    size = (-(-width // factor), -(-height // factor))
    return replace(intrinsics, size_wh=size, matrix=matrix)


def _knots(length: int) -> Floats:
    """Positions from before the first to after the last of `length` pixels, about 8 px apart."""
    return np.linspace(-2.0, length + 1.0, max(length // _BLOCK_PX, 8))


def _beside(differ: Callable[[Index, Index], Bools], shape: tuple[int, int]) -> Bools:
    """Pixels (h, w) that differ from one of their eight neighbours."""
    out = np.zeros(shape, bool)
    for a, b in (
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        hit = differ(a, b)
        out[a] |= hit
        out[b] |= hit
    return out


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

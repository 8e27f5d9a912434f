"""Ray casting: what the rays of a camera meet, and the radiance of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.limits import AT_ONCE
from measure.simulation import kernels
from measure.simulation.kernels import NOTHING, REUSE, RayHits, choose_lit, meet, no_points
from measure.simulation.light_kernels import LAMP_ROW, Lights, mean_of_pixels, reflect
from measure.simulation.scene import Capsule, Cuboid, Lighting, Mirror, Shape, Sphere, Texture

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

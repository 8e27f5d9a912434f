"""A body's balls as compiled code takes them: what is known of them is put together once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints, stacked
from measure.model import Body, Camera, Expectation, Image
from measure_plugins._outline.appearance.model import Appearance
from measure_plugins._outline.fitting.batch import (
    Expected,
    Measured,
    cones_of,
    measure_balls,
    measure_gains,
)
from measure_plugins._outline.fitting.scan import View
from measure_plugins.detectors._outline_settings import (
    FEWEST_RAYS,
    HOPELESS,
    ROUGHLY,
    OutlineConfig,
)
from measure_plugins.detectors._wide_windows import center_by_size

_NO_GAIN = np.eye(2)


class _Known(NamedTuple):
    """What is known of k balls wherever they are: radii (k,) in mm, the others as in `Expected`."""

    radii: Floats
    sized: Bools
    bits: Ints
    gains: Floats


class KnownBalls:
    """Measures expected balls of one body in one camera; remembers how looks at each answer."""

    def __init__(
        self,
        config: OutlineConfig,
        body: Body,
        camera: Camera,
        bits: Mapping[str, int],
        colors: Bytes,
    ) -> None:
        """Balls of a body before a camera; `bits` of their colours in a table of `colors`."""
        self._config, self._camera, self._lens = config, camera, camera.intrinsics.row
        self._bits, self._colors = bits, colors
        self._radii = {ball.name: ball.radius_mm for ball in body.balls}
        self._gains: dict[str, Floats] = {}
        self._known: dict[tuple[str, ...], _Known] = {}

    def view(self, image: Image, seen: Appearance) -> View:
        """A picture ready to be looked at, as the camera shows things."""
        pixels = np.ascontiguousarray(image.pixels)
        lens, believed = self._lens, seen.believed
        return View(pixels, seen.table, seen.sensor, lens, seen.lamps, seen.room, believed)

    def cones(self, expected: Sequence[Expectation]) -> Floats:
        """Axes, half angles in rad, distances in mm, and radii in px of outlines: (k, 6)."""
        centers = [
            center_by_size(e, self._camera, self._radii[e.ball])
            if e.center_camera is None
            else e.center_camera
            for e in expected
        ]
        return cones_of(stacked(centers), self._of(expected).radii, self._lens)

    def measured(
        self, view: View, expected: Sequence[Expectation], cones: Floats, seen: Appearance
    ) -> Measured:
        """Corrected edges where the distance, and so the size, is known; else rough ones.

        Args:
            view: the picture.
            expected: k >= 1 balls.
            cones: (k, 6) as from `cones`.
            seen: how the camera shows them.
        """
        c, balls = self._config, self._packed(expected, cones, seen)
        rays = c.rays if balls.tables.size else max(c.rays // ROUGHLY, FEWEST_RAYS)
        hopeless = HOPELESS * c.min_agreement
        return measure_balls(view, balls, rays, c.min_contrast, c.margin_px, hopeless, self._colors)

    def gains_about(
        self, view: View, expected: Sequence[Expectation], settled: Floats, seen: Appearance
    ) -> Floats:
        """How looks answer (k, 2, 2) at balls whose outlines (k, 6) are `settled`."""
        c, balls = self._config, self._packed(expected, settled, seen)
        return measure_gains(view, balls, c.rays, c.min_contrast, c.margin_px)

    @property
    def knows_gains(self) -> bool:
        """Whether it is known how looks at each ball answer."""
        return len(self._gains) == len(self._radii)

    def without_gain(self, balls: Iterable[str]) -> list[str]:
        """Those of which it is not known how looks answer."""
        return [ball for ball in balls if ball not in self._gains]

    def learn_gains(self, gains: Mapping[str, Floats]) -> None:
        """How looks answer (2, 2) at some balls, by name."""
        self._gains.update(gains)
        self._known.clear()

    def forget_gains(self) -> None:
        """They hold for one way in which the camera shows balls."""
        self._gains.clear()
        self._known.clear()

    def _packed(self, expected: Sequence[Expectation], cones: Floats, seen: Appearance) -> Expected:
        known, reach_px = self._of(expected), np.array([e.reach_px for e in expected])
        unsized = [e.center_camera is None for e in expected]
        if all(unsized):
            no_tables = np.empty((len(cones), 0))
            return Expected(cones, reach_px, no_tables, ~known.sized, known.bits, known.gains)
        tables = seen.packed_tables([(size, angle) for *_, angle, _, size in cones.tolist()])
        sized = ~np.array(unsized) if any(unsized) else known.sized
        return Expected(cones, reach_px, tables, sized, known.bits, known.gains)

    def _of(self, expected: Sequence[Expectation]) -> _Known:
        """What is known of the balls, which are nearly always the same ones."""
        balls = tuple([e.ball for e in expected])
        known = self._known.get(balls)
        if known is None:
            known = self._known[balls] = _Known(
                np.array([self._radii[ball] for ball in balls]),
                np.ones(len(balls), np.bool_),
                np.array([self._bits[ball] for ball in balls]),
                np.array([self._gains.get(ball, _NO_GAIN) for ball in balls]),
            )
        return known


_RADIUS_PX = 40.0
_SHARE = 0.3
"""Of a small picture's shorter side: the rays must find the disc's surroundings in it."""


def drawn_disc(body: Body, camera: Camera) -> tuple[Image, list[Expectation]]:
    """A picture with one white disc in its middle, and the expectation of the first ball there."""
    width, height = camera.intrinsics.size_wh
    radius = min(_RADIUS_PX, _SHARE * min(width, height))
    pixels = np.zeros((height, width, 3), np.uint8)
    center = np.array([width / 2, height / 2])
    cv2.circle(pixels, (width // 2, height // 2), int(radius), (255, 255, 255), -1)
    image = Image(camera.name, 0, 0.0, lambda: pixels)
    half_angle = radius / camera.intrinsics.focal_px
    distance = body.balls[0].radius_mm / np.sin(half_angle)
    expected = Expectation(
        body.names[0],
        center,
        (radius - 5, radius + 5),
        0.0,
        reach_px=6.0,
        center_camera=distance * camera.intrinsics.unproject(center[None])[0],
    )
    return image, [expected]

"""A body's balls as records for compiled code, and as they are searched by colour in wide windows.

Rays across a predicted outline miss a ball that lies beside it. A body that was just found and
moves, or is seen a few times a second, may be anywhere in a window wider than the ball.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, stacked
from measure.host import Settings, setting
from measure.model import Body, Camera, Detection, Expectation, Image
from measure.model.lens import bearing
from measure_plugins._outline import measurement
from measure_plugins._outline.appearance import Appearance, balls_behind, balls_nearer
from measure_plugins._outline.measurement import measure_step_gain
from measure_plugins._outline.scan import CameraImage, OutlineSearch

FEWER_RAYS, MIN_RAYS = 2, 16
"""Divisor of the number of rays across outlines of unknown size, and the least number."""
GIVE_UP_SHARE = 2 / 3
"""Share of the least agreement below which a candidate is given up before it has converged."""


class OutlineConfig(Settings):
    """Settings of the `outline` detector."""

    rays: int = setting(
        72, "Rays cast across each outline, an even number.", ge=16, le=720, multiple_of=2
    )
    tone: str = setting(
        "srgb", "The cameras' tone curve: srgb, none, or gamma with its exponent (gamma2.2)."
    )
    self_calibrate: bool = setting(
        True,
        "Whether the tone curve, the blur, the gloss of the balls and the lights are estimated "
        "from the images, starting from the tone curve given here.",
    )
    min_contrast: float = setting(
        0.06,
        "Least difference of a ray's inside and outside, as a share of the largest picture value.",
        gt=0,
    )
    min_color_match: float = setting(
        0.25, "Least share of samples inside the border that have the ball's colour.", ge=0, le=1
    )
    min_agreement: float = setting(
        0.45,
        "Least share of the rays that should show an edge whose edges lie on one outline.",
        ge=0,
        le=1,
    )
    min_rays: int = setting(12, "Fewest edge points an outline is fitted to.", ge=6)
    margin_px: float = setting(
        7.0, "Rays nearer than this to a nearer ball's outline are left out.", unit="px", ge=0
    )


_UNIT_GAIN = np.eye(2)


class KnownBalls:
    """Measures expected balls of one body in one camera; keeps the step gain of each."""

    def __init__(
        self,
        config: OutlineConfig,
        body: Body,
        camera: Camera,
        bits: Mapping[str, int],
        colors: Bytes,
    ) -> None:
        """For the balls of a body; `bits` of their colours in the table `colors`."""
        self._config, self._camera, self._lens = config, camera, camera.intrinsics.row
        self._bits, self._colors = bits, colors
        self._radii = {ball.name: ball.radius_mm for ball in body.balls}
        self._step_gains: dict[str, Floats] = {}

    def view(self, image: Image, appearance: Appearance) -> CameraImage:
        """A picture and its camera's appearance, for compiled code."""
        return CameraImage(
            np.ascontiguousarray(image.pixels),
            appearance.table,
            appearance.encoding,
            self._lens,
            appearance.point_lights,
            appearance.correction_weight,
        )

    def cones(self, expected: Sequence[Expectation]) -> Floats:
        """Outlines (k, 6) of k balls, see `batch.cones_of`."""
        centers = [
            center_by_size(e, self._camera, self._radii[e.ball])
            if e.center_camera is None
            else e.center_camera
            for e in expected
        ]
        radii = np.array([self._radii[e.ball] for e in expected])
        return measurement.cones_of(stacked(centers), radii, self._lens)

    def measured(
        self,
        view: CameraImage,
        expected: Sequence[Expectation],
        cones: Floats,
        appearance: Appearance,
    ) -> list[measurement.Measured]:
        """With corrected edges where the distance, and so the size, is known; else without.

        Args:
            expected: k >= 1 balls.
            cones: (k, 6) as from `cones`.
        """
        c = self._config
        sized = any(e.center_camera is not None for e in expected)
        rays = c.rays if sized else max(c.rays // FEWER_RAYS, MIN_RAYS)
        searches = self._searches(expected, cones, appearance, rays)
        return measurement.measure_balls(
            view, searches, GIVE_UP_SHARE * c.min_agreement, self._colors
        )

    def measured_step_gains(
        self,
        view: CameraImage,
        expected: Sequence[Expectation],
        cones: Floats,
        appearance: Appearance,
    ) -> dict[str, Floats]:
        """Step gains (2, 2) of balls of known size whose outlines `cones` (k, 6) have converged."""
        searches = self._searches(expected, cones, appearance, self._config.rays)
        return {
            e.ball: measure_step_gain(view, search, tables)
            for e, (search, tables, _) in zip(expected, searches, strict=True)
            if tables is not None
        }

    def _searches(
        self, expected: Sequence[Expectation], cones: Floats, appearance: Appearance, rays: int
    ) -> list[measurement.BallSearch]:
        c = self._config
        return [
            measurement.BallSearch(
                OutlineSearch(
                    axis=cone[:3],
                    half_angle=cone[3],
                    nearer=balls_nearer(cone, cones),
                    behind=balls_behind(cone, cones),
                    reach_px=float(e.reach_px),
                    rays=rays,
                    min_contrast=c.min_contrast,
                    margin_px=c.margin_px,
                    distance=cone[4],
                    step_gain=self._step_gains.get(e.ball, _UNIT_GAIN),
                ),
                None if e.center_camera is None else appearance.tables(cone[5], cone[3]),
                self._bits[e.ball],
            )
            for e, cone in zip(expected, cones, strict=True)
        ]

    @property
    def knows_step_gains(self) -> bool:
        """Whether the step gains of all balls are known."""
        return len(self._step_gains) == len(self._radii)

    def without_step_gain(self, balls: Iterable[str]) -> list[str]:
        """Those whose step gain is not known."""
        return [ball for ball in balls if ball not in self._step_gains]

    def set_step_gains(self, step_gains: Mapping[str, Floats]) -> None:
        """Keep the step gains (2, 2) of some balls, by name."""
        self._step_gains.update(step_gains)

    def clear_step_gains(self) -> None:
        """Forget the step gains: they hold for one appearance."""
        self._step_gains.clear()


_RADIUS_PX = 40.0
_SHARE = 0.3  # Largest radius, per shorter side of the picture: the rays must end inside it


def drawn_disc(body: Body, camera: Camera) -> tuple[Image, list[Expectation]]:
    """A picture of one white disc in its middle, and the expectation of the first ball there."""
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


_CONVINCING_SHARE = 2 / 3  # Score above which a ball is not searched elsewhere
_CIRCLE_ERROR_PX = 4.0  # Error of a circle found by colour, in centre and radius
_REACH_SIGMAS = 3.5  # Reach of a window in standard deviations of the prediction


def lost_in_wide_windows(
    expected: Sequence[Expectation], found: Sequence[Detection]
) -> tuple[Expectation, ...]:
    """Balls not found, or with a low score, in a window that reaches further than their radius."""
    sure = {d.ball for d in found if d.score >= _CONVINCING_SHARE}
    return tuple(
        e
        for e in expected
        if e.ball not in sure and e.center_camera is not None and e.reach_px > sum(e.radius_px) / 2
    )


def moved_to_circles(
    lost: Sequence[Expectation], circles: Mapping[str, Floats], camera: Camera
) -> list[Expectation]:
    """Expectations of lost balls at circles of their colour in their windows.

    One circle is one ball: pairs are taken in the order of their likelihood, by the distance of a
    circle from the expected place and by how complete it is.

    Args:
        lost: balls expected somewhere in wide windows.
        circles: (k, 6) by name of the ball, see `FoundCircles`.
    """
    pairs = [
        (likelihood, i, (x, y))
        for i, e in enumerate(lost)
        for x, y, radius, seen, filled, *_ in circles[e.ball].tolist()
        if (likelihood := seen * filled * _nearness(e, x, y, radius)) > 0
    ]
    places: dict[int, tuple[float, float]] = {}
    for _, i, place in sorted(pairs, reverse=True):
        if i not in places and place not in places.values():
            places[i] = place
    return [_moved(lost[i], np.array(place), camera) for i, place in sorted(places.items())]


def _nearness(expected: Expectation, x: float, y: float, radius: float) -> float:
    """Relative likelihood of a ball at a circle, 1 at best; 0 outside its window."""
    low, high = expected.radius_px
    away_px = math.hypot(x - expected.center_px[0], y - expected.center_px[1])
    if (
        away_px > expected.reach_px
        or not low - _CIRCLE_ERROR_PX <= radius <= high + _CIRCLE_ERROR_PX
    ):
        return 0.0
    return math.exp(-((_REACH_SIGMAS * away_px / expected.reach_px) ** 2) / 2)


def better_of(
    found: Sequence[Detection], again: Sequence[Detection], lost: Sequence[Expectation]
) -> list[Detection]:
    """Detections `found`, with those of `lost` balls replaced by better ones of `again`."""
    best, names = {d.ball: d for d in found}, {e.ball for e in lost}
    for d in again:
        if d.ball in names and (d.ball not in best or d.score > best[d.ball].score):
            best[d.ball] = d
    return list(best.values())


def _moved(expected: Expectation, center_px: Floats, camera: Camera) -> Expectation:
    """The same ball, as far away, in another place of the picture."""
    assert expected.center_camera is not None
    distance = float(np.linalg.norm(expected.center_camera))
    axis = bearing(center_px, camera.intrinsics.row)
    return replace(
        expected, center_px=center_px, reach_px=_CIRCLE_ERROR_PX, center_camera=distance * axis
    )


def radii_about(radius_px: float) -> tuple[float, float]:
    """Smallest and largest radius in px of an outline found from a rough circle."""
    spread = 0.25 * radius_px + 3
    return radius_px - spread, radius_px + spread


def center_by_size(expectation: Expectation, camera: Camera, radius_mm: float) -> Floats:
    """Centre (3,) in mm in the camera frame of a ball of the expected size in the picture."""
    axis = bearing(expectation.center_px, camera.intrinsics.row)
    half_angle = sum(expectation.radius_px) / 2 / camera.intrinsics.focal_px
    return axis * (radius_mm / np.sin(half_angle))

"""`outline`: sub-pixel edge points all round a ball's outline, and the cone through them.

Each ray across the predicted outline is projected on its own inside-minus-outside colour, in light
(the tone curve undone before interpolation); the half-level crossings go into a robust fit of the
cone of rays tangent to the sphere, which gives the direction of the sphere's centre without the
ellipse's bias. The edge points travel on with the detection, for a joint fit of the pose.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.host import Detector, Settings, hookimpl, setting
from measure.model import Body, Camera, Detection, Expectation, Image

if TYPE_CHECKING:
    from measure_plugins._edges.appearance import Appearance
    from measure_plugins._edges.look import View
    from measure_plugins._edges.outline_fit import Outline
    from measure_plugins._edges.radial import Radial


_HOPELESS = 2 / 3
"""A candidate that so far reaches less than this of the least agreement is given up."""


class OutlineConfig(Settings):
    """Settings of the `outline` detector."""

    rays: int = setting(72, "Rays cast across each outline.", ge=16, le=720)
    tone: str = setting(
        "srgb", "The cameras' tone curve: srgb, none, or gamma with its exponent (gamma2.2)."
    )
    learn: bool = setting(
        True,
        "Whether the tone curve, the blur, whether balls are glossy or matt, what they mirror and "
        "what lights them are learnt from the pictures, starting from the tone curve given here.",
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


class OutlineDetector(Detector):
    """Sub-pixel outlines near their predictions; without one, the whole frame is searched."""

    name = "outline"
    Config = OutlineConfig
    config: OutlineConfig

    def __init__(self, config: Settings, body: Body, camera: Camera) -> None:
        super().__init__(config, body, camera)
        from measure_plugins._acquisition.color_table import color_table
        from measure_plugins._edges.appearance import first_appearance
        from measure_plugins._edges.learner import AppearanceLearner

        self._lens = camera.intrinsics.row
        self._see(first_appearance(self.config.tone))
        self._learner = AppearanceLearner(self._lens, self.config.rays, self.config.margin_px)
        self._colors = tuple(dict.fromkeys(ball.color for ball in body.balls))
        self._table = color_table(self._colors)
        self._bits = {ball.name: 1 << self._colors.index(ball.color) for ball in body.balls}

    def _see(self, appearance: Appearance) -> None:
        """Look at pictures through this appearance from now on."""
        from measure_plugins._edges.sensor import encoding

        self._appearance = appearance
        self._tone = appearance.table()
        self._encoding = encoding(self._tone)

    def warm_up(self) -> None:
        """Compile the hot loops (seconds, once per machine), by measuring a drawn disc."""
        from measure_plugins import _acquisition
        from measure_plugins._edges.warm_up import drawn_disc

        _acquisition.warm_up()
        image, expected = drawn_disc(self.body, self.camera)
        self._measure(image, expected)
        self._measure(image, [replace(one, center_camera=None) for one in expected])
        self._searched(image, ())
        self._learner.warm_up(image.pixels, self._cone(expected[0]), self._appearance)

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Measure the expected balls; search the frame for the others."""
        found = self._measure(image, expected)
        known = {expectation.ball for expectation in expected}
        if len(known) == len(self.body.balls):
            return self._learnt(image, expected, found) or found
        return found + self._searched(image, known)

    def _searched(self, image: Image, known: Collection[str]) -> list[Detection]:
        """All that may be balls that are not `known`; what one ball may be, any of its colour."""
        from measure_plugins._acquisition import AcquisitionSettings, find_circles
        from measure_plugins._edges.outline_fit import approach

        c, view, found = self.config, self._view(image), list[Detection]()
        circles = find_circles(view.pixels, self._colors, AcquisitionSettings())
        for color, some in zip(self._colors, circles, strict=True):
            alike = [b.name for b in self.body.balls if b.color == color and b.name not in known]
            if not alike:
                continue
            near = approach(view, some, c.rays // 2, c.min_contrast, c.min_agreement)
            for (x, y, radius, *_), cone in zip(some, near, strict=True):
                if cone[3] == 0:
                    continue
                expectation = _expectation(alike[0], np.array([x, y]), radius)
                one = self._measure_one(image, view, expectation, (cone[:3], cone[3], np.inf), ())
                found += [replace(one, ball=name) for name in alike] if one else []
        return found

    def _learnt(
        self, image: Image, expected: Sequence[Expectation], found: Sequence[Detection]
    ) -> list[Detection]:
        """A picture's detections once more, if it has just taught something; else none."""
        if not self.config.learn or any(e.center_camera is None for e in expected):
            return []
        if not self._learner.wants(len(found)):
            return []
        cones = {e.ball: self._cone(e) for e in expected}
        axes = {d.ball: self.camera.intrinsics.unproject(d.center_px[None])[0] for d in found}
        seen = [(axis, *cones.pop(ball)[1:]) for ball, axis in axes.items()]
        learnt = self._learner.shown(image.pixels, seen, list(cones.values()), self._appearance)
        if learnt is None:
            return []
        self._see(learnt)
        return self._measure(image, expected)

    def _view(self, image: Image) -> View:
        from measure_plugins._edges.look import View

        pixels, lamps = np.ascontiguousarray(image.pixels), self._appearance.lamps
        return View(pixels, self._tone, self._encoding, self._lens, lamps)

    def _measure(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        view = self._view(image)
        cones = [self._cone(expectation) for expectation in expected]
        found = [
            self._measure_one(image, view, expectation, cone, cones)
            for expectation, cone in zip(expected, cones, strict=True)
        ]
        return [detection for detection in found if detection is not None]

    def _measure_one(
        self,
        image: Image,
        view: View,
        expectation: Expectation,
        cone: tuple[Floats, float, float],
        cones: Sequence[tuple[Floats, float, float]],
    ) -> Detection | None:
        outline = self._outline(view, expectation, cone, cones)
        if outline.agreeing < self.config.min_rays:
            return None
        agreement = outline.agreeing / max(outline.clear + outline.overflow, 1)
        low, high = expectation.radius_px
        if agreement < self.config.min_agreement or not (low - 2 <= outline.radius_px <= high + 2):
            return None
        match = self._color_match(view, expectation.ball, outline)
        if match < self.config.min_color_match:
            return None
        return Detection(
            ball=expectation.ball,
            camera=image.camera,
            time_s=image.time_s,
            center_px=outline.center_px,
            radius_px=outline.radius_px,
            covariance_px=outline.covariance_px,
            score=float(min(1.0, agreement)),
            color_match=match,
            outline_px=outline.points_px,
            outline_sd_px=outline.sd_px,
        )

    def _outline(
        self,
        view: View,
        expectation: Expectation,
        cone: tuple[Floats, float, float],
        cones: Sequence[tuple[Floats, float, float]],
    ) -> Outline:
        """Corrected edges where the distance, and so the size, is known; else rough ones."""
        from measure_plugins._edges.look import Search
        from measure_plugins._edges.outline_fit import measure_closely, measure_roughly

        axis, half_angle, distance = cone
        nearer = [[*a, h] for a, h, d in cones if d < distance - 1e-6]
        search = Search(
            axis,
            half_angle,
            np.array(nearer, dtype=np.float64).reshape(-1, 4),
            expectation.reach_px,
            self.config.rays,
            self.config.min_contrast,
            self.config.margin_px,
        )
        if expectation.center_camera is None:
            return measure_roughly(view, search, _HOPELESS * self.config.min_agreement)
        return measure_closely(view, search, self._radial(axis, half_angle))

    def _radial(self, axis: Floats, half_angle: float) -> Radial:
        """What a ball of this size, here, shows along a ray across its outline."""
        from measure_plugins._edges.rays import radius_px

        return self._appearance.tables(radius_px(axis, half_angle, self._lens), half_angle)

    def _cone(self, expectation: Expectation) -> tuple[Floats, float, float]:
        """Predicted axis, half angle in rad and distance in mm of a ball's outline."""
        radius = self.body.balls[self.body.index(expectation.ball)].radius_mm
        if expectation.center_camera is not None:
            distance = float(np.linalg.norm(expectation.center_camera))
            return (
                expectation.center_camera / distance,
                float(np.arcsin(radius / distance)),
                distance,
            )
        from measure.model.lens import bearing_and_slopes

        axis = np.empty(3)
        bearing_and_slopes(expectation.center_px, self._lens, 0.0, 0.0, axis, np.empty(6))
        half_angle = sum(expectation.radius_px) / 2 / self.camera.intrinsics.focal_px
        return axis, half_angle, radius / float(np.sin(half_angle))

    def _color_match(self, view: View, ball: str, outline: Outline) -> float:
        """Share of the samples between centre and edge points that have the ball's colour."""
        from measure_plugins._edges.color_check import color_share

        return color_share(
            view.pixels, self._table, self._bits[ball], outline.center_px, outline.points_px
        )


def _expectation(ball: str, center_px: Floats, radius_px: float) -> Expectation:
    """What a rough circle, approached, lets us expect."""
    spread = 0.25 * radius_px + 3
    return Expectation(
        ball=ball,
        center_px=center_px,
        radius_px=(radius_px - spread, radius_px + spread),
        min_distance_px=0.0,
        reach_px=0.0,
    )


@hookimpl
def measure_detectors() -> list[type[Detector]]:
    """Register `outline`."""
    return [OutlineDetector]

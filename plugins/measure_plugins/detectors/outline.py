"""`outline`: sub-pixel edge points all round a ball's outline, and the cone through them.

Each ray across the predicted outline is projected on its own inside-minus-outside colour, in light
(the tone curve undone before interpolation); the half-level crossings go into a robust fit of the
cone of rays tangent to the sphere, which gives the direction of the sphere's centre without the
ellipse's bias. The edge points travel on with the detection, for a joint fit of the pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Floats
from measure.host import Detector, Settings, hookimpl, setting
from measure.model import Ball, Body, Camera, Detection, Expectation, Image

_COLOR_RINGS = (0.25, 0.5, 0.7, 0.85)
"""Radii, as shares of the outline's, where the ball's colour is checked."""


class OutlineConfig(Settings):
    """Settings of the `outline` detector."""

    rays: int = setting(72, "Rays cast across each outline.", ge=16, le=720)
    tone: str = setting(
        "srgb", "The cameras' tone curve: srgb, none, or gamma with its exponent (gamma2.2)."
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
        from measure_plugins._edges.lens import lens_row
        from measure_plugins._edges.tone import tone_table

        self._lens = lens_row(camera.intrinsics)
        self._table = tone_table(self.config.tone)

    def warm_up(self) -> None:
        """Compile the hot loops (seconds, once per machine), by measuring a drawn disc."""
        from measure_plugins._edges.warm_up import drawn_disc

        self._measure(*drawn_disc(self.body, self.camera))

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Measure the expected balls; search the frame for the others."""
        found = self._measure(image, expected)
        known = {expectation.ball for expectation in expected}
        if len(known) == len(self.body.balls):
            return found
        from measure_plugins._acquisition import AcquisitionSettings, find_candidates

        for candidate in find_candidates(image, self.body, self.camera, AcquisitionSettings()):
            if candidate.ball not in known:
                found += self._measure(image, [_expectation(candidate)]) or []
        return found

    def _measure(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        cones = [self._cone(expectation) for expectation in expected]
        out = []
        for i, expectation in enumerate(expected):
            detection = self._measure_one(image, expectation, cones[i], cones)
            if detection is not None:
                out.append(detection)
        return out

    def _measure_one(
        self,
        image: Image,
        expectation: Expectation,
        cone: tuple[Floats, float, float],
        cones: Sequence[tuple[Floats, float, float]],
    ) -> Detection | None:
        from measure_plugins._edges.outline_fit import Search, View, measure_outline

        axis, half_angle, distance = cone
        nearer = [[*a, h] for a, h, d in cones if d < distance - 1e-6]
        search = Search(
            axis,
            half_angle,
            np.array(nearer, dtype=np.float64).reshape(-1, 4),
            expectation.reach_px,
            expectation.center_camera is not None,
            self.config.rays,
            self.config.min_contrast,
            self.config.margin_px,
        )
        outline = measure_outline(View(image.pixels, self._table, self._lens), search)
        if outline is None or outline.agreeing < self.config.min_rays:
            return None
        agreement = outline.agreeing / max(outline.clear + outline.overflow, 1)
        low, high = expectation.radius_px
        if agreement < self.config.min_agreement or not (low - 2 <= outline.radius_px <= high + 2):
            return None
        ball = self.body.balls[self.body.index(expectation.ball)]
        match = self._color_match(image, ball, outline.center_px, outline.points_px)
        if match < self.config.min_color_match:
            return None
        return Detection(
            ball=ball.name,
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
        axis = self.camera.intrinsics.unproject(expectation.center_px[None])[0]
        half_angle = float(np.mean(expectation.radius_px)) / self.camera.intrinsics.focal_px
        return axis, half_angle, radius / float(np.sin(half_angle))

    def _color_match(self, image: Image, ball: Ball, center: Floats, points: Floats) -> float:
        """Share of the samples between centre and edge points that have the ball's colour."""
        arms = (points - center)[None] * np.array(_COLOR_RINGS)[:, None, None]
        pixels = np.rint(center + arms.reshape(-1, 2)).astype(int)
        height, width = image.pixels.shape[:2]
        within = np.all((pixels >= 0) & (pixels < [width, height]), axis=1)
        if not within.any():
            return 0.0
        x, y = pixels[within].T
        return float(np.mean(ball.color.matches(image.pixels[y, x])))


def _expectation(candidate: Detection) -> Expectation:
    """What a rough circle lets us expect."""
    spread = 0.25 * candidate.radius_px + 3
    return Expectation(
        ball=candidate.ball,
        center_px=candidate.center_px,
        radius_px=(candidate.radius_px - spread, candidate.radius_px + spread),
        min_distance_px=0.0,
        reach_px=0.2 * candidate.radius_px,
    )


@hookimpl
def measure_detectors() -> list[type[Detector]]:
    """Register `outline`."""
    return [OutlineDetector]

"""`outline`: sub-pixel edge points all round a ball's outline, and the cone through them.

Each ray across the predicted outline is projected on its own inside-minus-outside colour, in light
(the tone curve undone before interpolation); the half-level crossings go into a robust fit of the
cone of rays tangent to the sphere, which gives the direction of the sphere's centre without the
ellipse's bias. The edge points travel on with the detection, for a joint fit of the pose.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from measure.arrays import Floats
from measure.host import Detector, SelfCalibratingDetector, Settings, hookimpl
from measure.model import BallColor, Body, Camera, Detection, Expectation, Image
from measure_plugins.detectors._coarse_color import has_fringes, with_coarse_color
from measure_plugins.detectors._known_balls import (
    FEWER_RAYS,
    GIVE_UP_SHARE,
    MIN_RAYS,
    OutlineConfig,
    better_of,
    lost_in_wide_windows,
    moved_to_circles,
    radii_about,
)

if TYPE_CHECKING:
    from measure_plugins._acquisition import FoundCircles
    from measure_plugins._outline.appearance import Appearance
    from measure_plugins._outline.measurement import Measured
    from measure_plugins._outline.scan import CameraImage
    from measure_plugins._outline.self_calibration import BackgroundEstimation

_WHOLE_MATCH = 0.75
"""Share of a ball's inside with its colour below which its score is lower: balls of two colours are
not supported, and half-hidden ones are less sure."""

_SMALL_PX, _LEAST_SCORES = (7.0, 14.0), (0.8, 0.45)
"""Radii between which the score that a search asks for falls, and from what to what: of the few
pixels round a small outline many edges of anything agree. Balls of 7 px score 0.86 and more, print
and specks of wood 0.5 to 0.8."""


class OutlineDetector(SelfCalibratingDetector):
    """Sub-pixel outlines near their predictions; without one, the whole frame is searched."""

    name = "outline"
    provides_outlines = True
    Config = OutlineConfig
    config: OutlineConfig

    def __init__(self, config: Settings, body: Body, camera: Camera) -> None:
        super().__init__(config, body, camera)
        from measure_plugins._acquisition.color_table import with_shade
        from measure_plugins._outline.appearance import first_appearance
        from measure_plugins._outline.self_calibration import SelfCalibration
        from measure_plugins.detectors._known_balls import KnownBalls

        c, lens = self.config, camera.intrinsics.row
        self._appearance = first_appearance(c.tone)
        turned = camera.world_from_camera.rotation
        self._self_calibration = SelfCalibration(lens, turned, c.rays, c.margin_px)
        self._background: BackgroundEstimation | None = None
        self._has_fringes: bool | None = None  # of the camera's pictures; None before the first
        self._colors = tuple(dict.fromkeys(ball.color for ball in body.balls))
        self._table = with_shade(self._colors)
        self._bits = {ball.name: 1 << self._colors.index(ball.color) for ball in body.balls}
        self._balls = KnownBalls(c, body, camera, self._bits, self._table)

    def warm_up(self) -> None:
        """Compile hot loops, once per machine."""
        for part in self.warm_up_parts():
            part()

    def warm_up_parts(self) -> Sequence[Callable[[], object]]:
        """Measurements of a drawn disc, by a detector of its own: its estimates are of the disc."""
        from measure_plugins import _acquisition
        from measure_plugins.detectors._known_balls import drawn_disc

        own = OutlineDetector(self.config, self.body, self.camera)
        image, expected = drawn_disc(self.body, self.camera)
        unsized = [replace(one, center_camera=None) for one in expected]
        cones, view = own._balls.cones(expected), own._view(image)
        pixels, cone, now = image.pixels, _cones(cones)[0], own._appearance
        return (
            lambda: own._measure(image, expected),
            lambda: own._measure(image, unsized),
            lambda: own._balls.measured_step_gains(view, expected, cones, now),
            lambda: own._self_calibration.warm_up(pixels, cone, now),
            lambda: own._searched(image, ()),
            _acquisition.warm_up,
        )

    @property
    def needs_burn_in(self) -> bool:
        """While there have not been enough estimates of the appearance."""
        return self.config.self_calibrate and not self._self_calibration.settled

    @property
    def calibration_state(self) -> object:
        """The last estimate of the appearance, if there have been enough."""
        return self._self_calibration.estimate

    def fuse_calibration(self, states: Sequence[object]) -> None:
        """Fuse point lights, correction weight and a common tone curve over all cameras."""
        from measure_plugins._outline.self_calibration import (
            AppearanceEstimate,
            has_common_response,
        )

        estimates = [state for state in states if isinstance(state, AppearanceEstimate)]
        bent = has_common_response(estimates)
        fused = self._self_calibration.fuse(self._appearance, estimates, bent)
        if fused is not self._appearance:
            self._set_appearance(fused)

    def enter_realtime(self) -> None:
        """Estimate in a thread from now on: an estimation takes as long as dozens of pictures."""
        from measure_plugins._outline.self_calibration import BackgroundEstimation

        self._background = BackgroundEstimation()

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Measure the expected balls; search the frame for the others."""
        if self._background is not None and (new := self._background.result()) is not None:
            self._set_appearance(new)
        if expected:
            image = self._without_fringes(image, expected)
        found = self._measure(image, expected)
        known = {expectation.ball for expectation in expected}
        if len(known) == len(self.body.balls):
            return self._recalibrated(image, expected, found) or found
        return found + self._searched(image, known)

    def _without_fringes(self, image: Image, expected: Sequence[Expectation]) -> Image:
        if self._has_fringes is None:
            self._has_fringes = has_fringes(image)
        return with_coarse_color(image, expected) if self._has_fringes else image

    def _searched(self, image: Image, known: Collection[str]) -> list[Detection]:
        """Candidates of balls that are not `known`; each may be any ball of its colour."""
        from measure_plugins._outline.measurement import measure_circles

        c, view = self.config, self._view(image)
        alike: dict[BallColor, list[str]] = {color: [] for color in self._colors}
        for ball in self.body.balls:
            if ball.name not in known:
                alike[ball.color].append(ball.name)
        circles = self._circles(view)
        kinds = list(zip(alike.values(), circles.of_color, strict=True))
        names = [names for names, some in kinds if names for _ in range(len(some))]
        rough = np.concatenate([some for names, some in kinds if names])
        found = measure_circles(
            view,
            rough,
            np.array([self._bits[first] for first, *_ in names], np.int64),
            (max(c.rays // FEWER_RAYS, MIN_RAYS), c.rays),
            c.min_contrast,
            GIVE_UP_SHARE * c.min_agreement,
            circles.table,
        )
        each = (
            self._detection(image, ball, radii_about(size_px), measured)
            for measured, size_px, balls in zip(found, rough[:, 2].tolist(), names, strict=True)
            for ball in balls
        )
        return [detection for detection in each if detection is not None and _is_sure(detection)]

    def _circles(self, view: CameraImage) -> FoundCircles:
        """Circles of each of the body's colours in a whole picture."""
        from measure_plugins._acquisition import find_circles

        return find_circles(view.pixels, self._colors)

    def _recalibrated(
        self, image: Image, expected: Sequence[Expectation], found: Sequence[Detection]
    ) -> list[Detection]:
        """Detections measured anew if the picture has changed the appearance; else none."""
        if not self.config.self_calibrate or any(e.center_camera is None for e in expected):
            return []
        if not self._self_calibration.wants_image(len(found), image.time_s):
            return []
        cones = dict(
            zip((e.ball for e in expected), _cones(self._balls.cones(expected)), strict=True)
        )
        axes = {d.ball: self.camera.intrinsics.unproject(d.center_px[None])[0] for d in found}
        seen = [(axis, *cones.pop(ball)[1:]) for ball, axis in axes.items()]
        estimation = self._self_calibration.add_image(
            image.pixels, seen, list(cones.values()), self._appearance
        )
        if estimation is None:
            return []
        if self._background is not None:
            self._background.start(estimation)
            return []
        self._set_appearance(estimation())
        return self._measure(image, expected)

    def _set_appearance(self, appearance: Appearance) -> None:
        self._appearance = appearance
        self._balls.clear_step_gains()

    def _view(self, image: Image) -> CameraImage:
        return self._balls.view(image, self._appearance)

    def _measure(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """The expected balls; once more if step gains were measured at those found."""
        if not expected:
            return []
        view, cones = self._view(image), self._balls.cones(expected)
        found = self._measure_at(image, view, expected, cones)
        lost = lost_in_wide_windows(expected, found)
        if moved := self._moved_by_color(view, expected, lost):
            expected, cones = moved, self._balls.cones(moved)
            found = better_of(found, self._measure_at(image, view, expected, cones), lost)
        if not self._update_step_gains(view, expected, cones, found):
            return found
        return self._measure_at(image, view, expected, cones)

    def _moved_by_color(
        self, view: CameraImage, expected: Sequence[Expectation], lost: Sequence[Expectation]
    ) -> list[Expectation]:
        """Expectations with `lost` balls moved to circles in their windows; none if none was."""
        if not lost:
            return []
        circles = dict(zip(self._colors, self._circles(view).of_color, strict=True))
        shown = {e.ball: circles[self.body.balls[self.body.index(e.ball)].color] for e in lost}
        moved = {e.ball: e for e in moved_to_circles(lost, shown, self.camera)}
        return [moved.get(e.ball, e) for e in expected] if moved else []

    def _update_step_gains(
        self,
        view: CameraImage,
        expected: Sequence[Expectation],
        cones: Floats,
        found: Sequence[Detection],
    ) -> bool:
        """Measure the step gains of balls that have none yet; whether there were any."""
        if self._balls.knows_step_gains:
            return False
        sized = {e.ball for e in expected if e.center_camera is not None}
        new = self._balls.without_step_gain([d.ball for d in found if d.ball in sized])
        if not new:
            return False
        row, cones = {e.ball: i for i, e in enumerate(expected)}, cones.copy()
        for d in found:
            cones[row[d.ball], :3] = self.camera.intrinsics.unproject(d.center_px[None])[0]
        step_gains = self._balls.measured_step_gains(view, expected, cones, self._appearance)
        self._balls.set_step_gains({ball: step_gains[ball] for ball in new})
        return True

    def _measure_at(
        self, image: Image, view: CameraImage, expected: Sequence[Expectation], cones: Floats
    ) -> list[Detection]:
        """Detections of expected balls with these outlines, see `KnownBalls.measured`."""
        found = self._balls.measured(view, expected, cones, self._appearance)
        each = [
            self._detection(image, one.ball, one.radius_px, measured)
            for one, measured in zip(expected, found, strict=True)
        ]
        return [detection for detection in each if detection is not None]

    def _detection(
        self, image: Image, ball: str, limits_px: tuple[float, float], measured: Measured
    ) -> Detection | None:
        """The detection of a ball that was measured; None if it fails the limits of a ball."""
        outline, match, rays = measured
        c, (low, high) = self.config, limits_px
        if (
            outline.agreeing < c.min_rays * rays / c.rays
            or outline.share < c.min_agreement
            or match < c.min_color_match
        ):
            return None
        if not low - 2 <= outline.radius_px <= high + 2:
            return None
        return Detection(
            ball,
            image.camera,
            image.time_s,
            outline.center_px,
            outline.radius_px,
            outline.covariance_px,
            score=min(1.0, outline.share) * min(1.0, match / _WHOLE_MATCH),
            color_match=match,
            outline_px=outline.points_px,
            outline_sd_px=outline.sd_px,
        )


def _is_sure(searched: Detection) -> bool:
    """Whether what a search has found may be a ball: small things have to look more like one."""
    from measure_plugins._acquisition import MIN_RADIUS_PX

    radius_px = searched.radius_px
    least = np.interp(radius_px, _SMALL_PX, _LEAST_SCORES) if radius_px < _SMALL_PX[1] else 0.0
    return bool(radius_px >= MIN_RADIUS_PX and searched.score >= least)


def _cones(rows: Floats) -> list[tuple[Floats, float, float]]:
    """Axis, half angle and distance of each outline."""
    return [(row[:3], float(row[3]), float(row[4])) for row in rows]


@hookimpl
def measure_detectors() -> list[type[Detector]]:
    """Register `outline`."""
    return [OutlineDetector]

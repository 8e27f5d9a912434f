"""The paper's circle detector: Canny edges inside colour segments, Hough, colour check.

Peng, Yang, Su, Hannaford (ICRA 2020), section II.C "Auto Hough Circle Detection" and its figure.
The paper's weaknesses are kept: the outline is modelled as a circle whose centre is the image of
the ball's centre, and centres fall on whole pixels of the accumulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from measure.arrays import Bytes, Floats
from measure.errors import ConfigError
from measure.host import Detector, Settings, hookimpl, setting
from measure.model import Ball, Body, Camera, ConvertedImage, Detection, Expectation, Image
from measure_paper import _hough_steps as steps
from measure_paper._hough_steps import (
    CircleWindow,
    Find,
    HoughSearch,
    cut,
    finder,
    regions,
    tune_blur,
)

_SAME_COLOR_SHARE = 0.5
"""Two colours are indistinguishable where one covers this share of the other."""

_FIRST_THRESHOLD = 24
"""Votes at which the bisection starts in a whole frame, where low thresholds are slow to try."""


class HoughSettings(Settings):
    """Settings of `hough`."""

    blur_sigma_px: float = setting(
        1.5, "Sigma of the Gaussian blur of the gray image before Canny.", unit="px", gt=0, le=20
    )
    blur_sigma_max_px: float = setting(
        3.0,
        "Largest sigma of that blur; where it is reached, the search ends.",
        unit="px",
        gt=0,
        le=20,
    )
    blur_sigma_step_px: float = setting(
        0.75, "Step by which sigma is raised when the number of circles jumps.", unit="px", ge=0.1
    )
    edge_threshold: float = setting(
        40.0, "Upper threshold of Canny on the gray image; the lower one is half of it.", gt=0
    )
    channel_blur_percent: float = setting(
        10.0,
        "Sigma of the Gaussian blur of a colour channel, as a share of the radius.",
        unit="%",
        gt=0,
        le=100,
    )
    channel_level_percent: float = setting(
        15.0,
        "Level of the binarisation; a lower level enlarges the segments.",
        unit="%",
        gt=0,
        lt=100,
    )
    dp: float = setting(1.0, "Inverse resolution of the Hough accumulator.", ge=0.5, le=8)
    param1: float = setting(100.0, "Upper Canny threshold inside the Hough transform.", gt=0)
    lowest_threshold: int = setting(
        6, "Lowest accumulator threshold (param2) of the bisection.", unit="votes", ge=1
    )
    circles: int = setting(
        1, "Number of circles per colour in a search of the whole frame.", ge=1, le=20
    )
    min_distance_radii: float = setting(
        2.0, "Least distance of two centres in a search of the whole frame, in radii.", gt=0
    )
    nearest_mm: float = setting(
        250.0,
        "Least distance of a ball from the camera in a search of the whole frame.",
        unit="mm",
        gt=0,
    )
    farthest_mm: float = setting(
        900.0,
        "Largest distance of a ball from the camera in a search of the whole frame.",
        unit="mm",
        gt=0,
    )
    color_percent: float = setting(
        25.0,
        "Least share of the samples near the border that have the ball's colour.",
        unit="%",
        ge=0,
        le=100,
    )
    color_samples: int = setting(
        72, "Number of directions sampled for the colour check.", ge=8, le=3600
    )
    center_sd_px: float = setting(
        1.0,
        "Standard deviation per axis of the centre of a fully visible circle.",
        unit="px",
        ge=1e-3,
        le=1e3,
    )


class HoughDetector(Detector):
    """Hough circles with automatic threshold, one colour at a time.

    A circle that fails the colour check is returned with `score` 0 and its `color_match` for an
    expected ball, so that tracking can say why; for a searched ball it is dropped.

    Raises:
        ConfigError: two balls of the body have one colour.
    """

    name = "hough"
    provides_outlines = False
    Config = HoughSettings
    config: HoughSettings

    def __init__(self, config: HoughSettings, body: Body, camera: Camera) -> None:
        super().__init__(config, body, camera)
        _refuse_one_color(body)
        if config.nearest_mm >= config.farthest_mm:
            raise ConfigError(
                f"detector 'hough': nearest_mm ({config.nearest_mm:g}) must be less than "
                f"farthest_mm ({config.farthest_mm:g})"
            )

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Find each ball in its window, or all over the picture; see `Detector.detect`."""
        by_ball = {expectation.ball: expectation for expectation in expected}
        whole = CircleWindow((0, 0), ConvertedImage(image.pixels))
        found = []
        for ball in self.body.balls:
            expectation = by_ball.get(ball.name)
            if expectation is None:
                found += self._searched(ball, image, whole)
            else:
                found += self._expected(ball, image, expectation)
        return found

    def _expected(self, ball: Ball, image: Image, expectation: Expectation) -> list[Detection]:
        reach = expectation.reach_px + 1.1 * expectation.radius_px[1]
        window = cut(image.pixels, expectation.center_px - reach, expectation.center_px + reach)
        if window is None:
            return []
        search = HoughSearch(
            expectation.radius_px,
            expectation.min_distance_px,
            circles=1,
            first_threshold=2 * self.config.lowest_threshold,
        )
        return self._circles(ball, image, window, search)

    def _searched(self, ball: Ball, image: Image, whole: CircleWindow) -> list[Detection]:
        radius_px = self._plausible_radii(ball)
        search = HoughSearch(
            radius_px,
            self.config.min_distance_radii * radius_px[0],
            circles=self.config.circles,
            first_threshold=_FIRST_THRESHOLD,
        )
        found = self._circles(ball, image, whole, search)
        return [detection for detection in found if detection.score > 0]

    def _plausible_radii(self, ball: Ball) -> tuple[float, float]:
        focal = self.camera.intrinsics.focal_px
        near = max(self.config.nearest_mm, 1.05 * ball.radius_mm)
        ranges = np.array([self.config.farthest_mm, near])
        radii = focal * ball.radius_mm / np.sqrt(ranges**2 - ball.radius_mm**2)
        return float(radii[0]), float(min(radii[1], max(self.camera.intrinsics.size_wh) / 2))

    def _edges(self, window: CircleWindow, sigma_px: float) -> Bytes:
        """Steps 1 to 3, once per window and blur."""
        if sigma_px not in window.edges:
            window.edges[sigma_px] = steps.gray_edges(
                window.image.bgr, sigma_px, self.config.edge_threshold
            )
        return window.edges[sigma_px]

    def _circles(
        self, ball: Ball, image: Image, window: CircleWindow, search: HoughSearch
    ) -> list[Detection]:
        """Steps 4 to 8 in one window."""
        config = self.config
        sigma = config.channel_blur_percent / 100 * float(np.mean(search.radius_px))
        channel = ball.color.mask_converted(window.image)
        segments = steps.enlarge(channel, sigma, config.channel_level_percent / 100)
        parts = regions(segments, search.radius_px[0], search.radius_px[1] / 2)
        if not parts:
            return []

        def find_with(sigma_px: float) -> Find:
            border = steps.refine_border(self._edges(window, sigma_px), segments)
            return finder(border, parts, search, config.dp, config.param1)

        tuned = tune_blur(
            find_with,
            self._blurs(),
            search.circles,
            lowest=config.lowest_threshold,
            start=search.first_threshold,
        )
        detections = [
            self._detection(ball, image, window, channel, circle) for circle in tuned.circles
        ]
        return sorted(detections, key=lambda detection: -detection.score)

    def _blurs(self) -> list[float]:
        config = self.config
        rises = int((config.blur_sigma_max_px - config.blur_sigma_px) / config.blur_sigma_step_px)
        return [
            config.blur_sigma_px + rise * config.blur_sigma_step_px
            for rise in range(max(rises, 0) + 1)
        ]

    def _detection(
        self, ball: Ball, image: Image, window: CircleWindow, channel: Bytes, circle: Floats
    ) -> Detection:
        share = steps.color_share(channel, circle, self.config.color_samples, (0.75, 0.9))
        # The less of the border is seen, the less the votes hold the centre.
        sd_px = self.config.center_sd_px / max(share, 0.1)
        return Detection(
            ball=ball.name,
            camera=self.camera.name,
            time_s=image.time_s,
            center_px=circle[:2] + np.array(window.origin, dtype=np.float64),
            radius_px=float(circle[2]),
            covariance_px=np.eye(2) * sd_px**2,
            score=share if 100 * share >= self.config.color_percent else 0.0,
            color_match=share,
        )


@hookimpl
def measure_detectors() -> list[type[Detector]]:
    """Register the detector."""
    return [HoughDetector]


def _refuse_one_color(body: Body) -> None:
    levels = np.arange(0, 256, 15, dtype=np.uint8)
    grid = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    held = {ball.name: ball.color.mask(grid) > 0 for ball in body.balls}
    for a, b in combinations(body.names, 2):
        smaller = min(int(held[a].sum()), int(held[b].sum()))
        common = int((held[a] & held[b]).sum())
        same = body.balls[body.index(a)].color == body.balls[body.index(b)].color
        if same or common > _SAME_COLOR_SHARE * max(smaller, 1):
            raise ConfigError(
                f"body '{body.name}': '{a}' and '{b}' are two balls of one colour, which the "
                "detector 'hough' cannot tell apart; give one another colour, or use "
                "--profile precise"
            )

"""A detector that takes the largest round patch of a ball's colour."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from measure.host import Detector, Settings, hookimpl, setting
from measure.model import Ball, Detection, Expectation, Image


class BlobSettings(Settings):
    """Settings of the `blob` detector."""

    least_radius_px: float = setting(8.0, "Smaller patches are noise.", unit="px", gt=0)
    roundness: float = setting(0.8, "Least share of its circle that a patch fills.", ge=0, le=1)
    center_sd_px: float = setting(1.0, "Standard deviation of a centre.", unit="px", gt=0)


class BlobDetector(Detector):
    """Patches of a ball's colour by connected components."""

    name = "blob"
    provides_outlines = False
    Config = BlobSettings
    config: BlobSettings

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Find the balls; an expected one where it is expected, the others anywhere."""
        by_ball = {expectation.ball: expectation for expectation in expected}
        found = []
        for ball in self.body.balls:
            candidates = self._patches(ball, image)
            if ball.name in by_ball:
                candidates = [d for d in candidates if _fits(d, by_ball[ball.name])][:1]
            found += candidates
        return found

    def _patches(self, ball: Ball, image: Image) -> list[Detection]:
        """Round patches of the ball's colour, the roundest first."""
        mask = cv2.morphologyEx(ball.color.mask(image.pixels), cv2.MORPH_OPEN, np.ones((5, 5)))
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        patches = [self._patch(ball, image, outline) for outline in outlines]
        return sorted((p for p in patches if p is not None), key=lambda p: -p.score)

    def _patch(self, ball: Ball, image: Image, outline: np.ndarray) -> Detection | None:
        hull = cv2.convexHull(outline)  # bridges highlights at the border and thin occluders
        center, radius = cv2.minEnclosingCircle(hull)
        if radius < self.config.least_radius_px:
            return None
        roundness = cv2.contourArea(hull) / (np.pi * radius**2)
        if roundness < self.config.roundness:
            return None
        return Detection(
            ball=ball.name,
            camera=image.camera,
            time_s=image.time_s,
            center_px=np.array(center),
            radius_px=float(radius),
            covariance_px=self.config.center_sd_px**2 * np.eye(2),
            score=float(min(roundness, 1.0)),
        )


def _fits(detection: Detection, expectation: Expectation) -> bool:
    low, high = expectation.radius_px
    off = np.linalg.norm(detection.center_px - expectation.center_px)
    return bool(off <= expectation.reach_px and 0.9 * low <= detection.radius_px <= 1.1 * high)


@hookimpl
def measure_detectors() -> list[type[Detector]]:
    """Register `blob`."""
    return [BlobDetector]

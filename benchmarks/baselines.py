"""The detectors people write first, to compare with; none of them is part of the program."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.host import Detector
from measure.model import Ball, Detection, Expectation, Image

Circle = tuple[float, float, float]

MIN_AREA_PX = 150


class MaskDetector(Detector):
    """Finds each ball by its colour mask, in a window if one is expected; a subclass fits it."""

    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """One detection for each ball whose mask yields a circle."""
        where = {expectation.ball: expectation for expectation in expected}
        found = (self._one(image, ball, where.get(ball.name)) for ball in self.body.balls)
        return [detection for detection in found if detection is not None]

    def fit(self, bgr: Bytes, mask: Bytes, radius_px: tuple[float, float]) -> Circle | None:
        """Centre and radius of the ball in a window."""
        raise NotImplementedError

    def _one(self, image: Image, ball: Ball, expected: Expectation | None) -> Detection | None:
        width, height = self.camera.intrinsics.size_wh
        left, top, right, bottom = 0, 0, width, height
        radius = (12.0, 150.0)
        if expected is not None:
            radius = expected.radius_px
            margin = radius[1] + expected.reach_px
            u, v = expected.center_px
            left, top = int(max(u - margin, 0)), int(max(v - margin, 0))
            right, bottom = int(min(u + margin, width)), int(min(v + margin, height))
        if right - left < 8 or bottom - top < 8:
            return None
        window = image.pixels[top:bottom, left:right]
        circle = self.fit(window, ball.color.mask(window), radius)
        if circle is None:
            return None
        u, v, r = circle
        return Detection(
            ball=ball.name,
            camera=self.camera.name,
            time_s=image.time_s,
            center_px=np.array([u + left, v + top]),
            radius_px=r,
            covariance_px=np.eye(2),
            color_match=1.0,
        )


def _largest(mask: Bytes) -> Floats | None:
    """The contour (n, 2) of the largest blob."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return None
    largest = max(contours, key=cv2.contourArea)
    if cv2.contourArea(largest) < MIN_AREA_PX:
        return None
    return np.asarray(largest, dtype=np.float64).reshape(-1, 2)


class MaskCentroid(MaskDetector):
    """Centroid of the largest blob."""

    name = "mask-centroid"

    def fit(self, bgr: Bytes, mask: Bytes, radius_px: tuple[float, float]) -> Circle | None:  # noqa: ARG002
        """The blob's centroid, and the radius of a disc of its area."""
        contour = _largest(mask)
        if contour is None:
            return None
        moments = cv2.moments(contour.astype(np.float32))
        u, v = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
        return u, v, float(np.sqrt(moments["m00"] / np.pi))


class FitEllipse(MaskDetector):
    """cv2.fitEllipse on the contour of the largest blob."""

    name = "fit-ellipse"

    def fit(self, bgr: Bytes, mask: Bytes, radius_px: tuple[float, float]) -> Circle | None:  # noqa: ARG002
        """The ellipse's centre and mean semi-axis."""
        contour = _largest(mask)
        if contour is None or len(contour) < 5:
            return None
        (u, v), (major, minor), _ = cv2.fitEllipse(contour.astype(np.float32))
        return (u, v, (major + minor) / 4) if np.isfinite(major + minor) else None


class OpenCvHough(MaskDetector):
    """cv2.HoughCircles on the colour mask, as in the tutorials."""

    name = "opencv-hough"
    method, parameters = cv2.HOUGH_GRADIENT, (100.0, 12.0)

    def fit(self, bgr: Bytes, mask: Bytes, radius_px: tuple[float, float]) -> Circle | None:  # noqa: ARG002
        """The circle with the most votes."""
        low, high = int(radius_px[0]), int(np.ceil(radius_px[1]))
        smooth = cv2.GaussianBlur(mask, (0, 0), 1.5)
        found = cv2.HoughCircles(
            smooth, self.method, 1.5, 4 * low, None, *self.parameters, low, high
        )
        if found is None:
            return None
        u, v, r = np.asarray(found, dtype=np.float64).reshape(-1, 3)[0]
        return float(u), float(v), float(r)


class OpenCvHoughAlt(OpenCvHough):
    """The same with HOUGH_GRADIENT_ALT."""

    name = "opencv-hough-alt"
    method, parameters = cv2.HOUGH_GRADIENT_ALT, (100.0, 0.6)


BASELINES: tuple[type[MaskDetector], ...] = (OpenCvHough, OpenCvHoughAlt, MaskCentroid, FitEllipse)

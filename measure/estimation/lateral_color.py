"""Lateral colour: how much larger than the green picture of a lens its red and blue pictures are.

Where a scene is grey, red and blue follow green, shifted away from the principal point. A block of
a picture gives one equation for the shift (least squares, as in Lucas and Kanade 1981).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import cv2
import numpy as np

from measure.arrays import Bytes, Floats, Singles
from measure.estimation.losses import student_weights
from measure.limits import SIGNIFICANT_SIGMAS
from measure.model import Camera, FrameSet

_BLOCK = 32  # Side of a block, in pixels of the picture reduced to half
_BLUR_PX = 1.2  # Blur of the reduced picture: chroma is blurred already, by JPEG and demosaicing
_LEAST_VARIANCE, _MOST_COLORED = 60.0, 0.05
"""Variance of a block that shows something, and share of a channel's that green may not explain."""
_NOISE = 0.05
_SLOPE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12
"""Derivative, right for polynomials of the fourth degree."""
_LEAST_BLOCKS = 40
_ITERATIONS = 20


class LateralColor(NamedTuple):
    """Magnification of red and blue against green, less 1, and standard deviations, (2,) each."""

    red_blue: Floats
    sd: Floats


def lateral_color(pictures: Iterable[tuple[Bytes, Floats]]) -> LateralColor | None:
    """Estimate the lateral colour of one camera, or of several of one make.

    Args:
        pictures: (h, w, 3) B G R, each with its camera's principal point (2,) in px.

    Returns:
        None if too little in the pictures is grey.
    """
    found: tuple[list[Floats], list[Floats]] = ([], [])
    for picture, principal_point in pictures:
        small = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(small.astype(np.float32), (0, 0), _BLUR_PX)
        for channel, blocks in zip((2, 0), found, strict=True):  # red and blue of BGR
            blocks.append(
                _blocks(np.asarray(blurred, np.float32), channel, (principal_point - 0.5) / 2)
            )
    known = [_robust_mean(np.hstack(blocks)) for blocks in found if blocks]
    if len(known) < 2 or not np.isfinite(known).all():
        return None
    values, sd = np.transpose(known)
    return LateralColor(values, sd)


def _blocks(picture: Singles, channel: int, center: Floats) -> Floats:
    """Magnifications and their weights (2, n) by the blocks of a picture that are grey."""
    green, seen = picture[:, :, 1], picture[:, :, channel]
    x = np.arange(seen.shape[1], dtype=np.float32) - np.float32(center[0])
    y = np.arange(seen.shape[0], dtype=np.float32) - np.float32(center[1])
    slope_x = cv2.filter2D(seen, cv2.CV_32F, _SLOPE[None])
    slope_y = cv2.filter2D(seen, cv2.CV_32F, _SLOPE[:, None])
    # What the channel changes by for a unit of magnification.
    change = -(slope_x * x + slope_y * y[:, None])
    parts = [_split(part) for part in (green, seen, change)]
    g, c, j = (part - part.mean(axis=1, keepdims=True) for part in parts)
    products = ((g, g), (c, c), (j, j), (g, c), (g, j), (c, j))
    gg, cc, jj, gc, gj, cj = (np.einsum("ij,ij->i", a, b) / _BLOCK**2 for a, b in products)
    with np.errstate(divide="ignore", invalid="ignore"):
        information, right = jj - gj**2 / gg, cj - gj * gc / gg
        unexplained = cc - gc**2 / gg - right**2 / information
        grey = (gg > _LEAST_VARIANCE) & (gc > 0) & (unexplained < _MOST_COLORED * cc)
        out = np.stack([right / information, information / (unexplained + _NOISE)])
    return np.asarray(out[:, grey], dtype=np.float64)


def _split(channel: Singles) -> Singles:
    """Blocks (n, pixels) of a channel; what is left at the right and lower border goes."""
    rows, columns = channel.shape[0] // _BLOCK, channel.shape[1] // _BLOCK
    cut = channel[: rows * _BLOCK, : columns * _BLOCK]
    blocks = cut.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2)
    return np.asarray(blocks.reshape(rows * columns, _BLOCK**2), np.float32)


def _robust_mean(blocks: Floats) -> tuple[float, float]:
    """Weighted mean of blocks (2, n) with Student-t weights, and its deviation by their scatter."""
    values, weights = blocks
    if len(values) < _LEAST_BLOCKS:
        return np.nan, np.nan
    mean, used = float(np.average(values, weights=weights)), weights
    for _ in range(_ITERATIONS):
        square = (values - mean) ** 2 * weights
        used = weights * student_weights(square / max(float(np.median(square)) / 0.455, 1e-30))
        mean = float(np.average(values, weights=used))
    scatter = float(np.sqrt(np.sum((used * (values - mean)) ** 2)) / np.sum(used))
    return mean, scatter


_FLOOR_PX = 0.04
"""Standard deviation at the picture's corner by colours of the scene, however many blocks agree."""
_SAME_FOCAL = 1.06  # Cameras whose focal lengths differ by no more than this factor are of one make


def with_lateral_color(
    cameras: Sequence[Camera], frame_sets: Iterable[FrameSet]
) -> tuple[Camera, ...]:
    """The cameras with the lateral colour that the first pictures show beyond doubt.

    Cameras of one size and focal length are of one make: what they see counts together.

    Args:
        cameras: those whose lateral colour is known keep it.
        frame_sets: from the start of a recording.
    """
    unknown = [camera for camera in cameras if camera.intrinsics.lateral_color is None]
    if not unknown:
        return tuple(cameras)
    seen = list(islice(frame_sets, 0, 12, 4))
    found: dict[str, Camera] = {}
    for camera in unknown:
        if camera.name not in found:
            alike = [one for one in unknown if one.name not in found and _of_one_make(one, camera)]
            found |= {one.name: one for one in _informed(alike, seen)}
    return tuple(found.get(camera.name, camera) for camera in cameras)


def _of_one_make(one: Camera, other: Camera) -> bool:
    a, b = one.intrinsics, other.intrinsics
    ratio = a.focal_px / b.focal_px
    return a.size_wh == b.size_wh and 1 / _SAME_FOCAL < ratio < _SAME_FOCAL


def _informed(alike: Sequence[Camera], seen: Sequence[FrameSet]) -> list[Camera]:
    """Cameras of one make with what their pictures show; as they are where that may be chance."""
    found = lateral_color(
        (frame_set.images[camera.name].pixels, camera.intrinsics.matrix[:2, 2])
        for frame_set in seen
        for camera in alike
        if camera.name in frame_set.images
    )
    if found is None:
        return list(alike)
    corner_px = np.hypot(*alike[0].intrinsics.size_wh) / 2
    sure = np.abs(found.red_blue) > SIGNIFICANT_SIGMAS * np.hypot(found.sd, _FLOOR_PX / corner_px)
    red, blue = np.where(sure, found.red_blue, 0.0).tolist()
    return [
        replace(one, intrinsics=replace(one.intrinsics, lateral_color=(red, blue))) for one in alike
    ]

"""Errors in a few numbers, as in the paper's Table I, and whether they fit what was promised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.geometry import chi_square_quantile, squared_mahalanobis

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class PositionErrors:
    """Position errors, measured minus true, over `count` samples.

    As in Table I of the paper: RMS about zero and SD about the mean. Per axis the SD is that of the
    signed error, so RMS^2 = mean^2 + SD^2. In 3-D it is that of the error's length about its mean
    length: only this reading fits the table (end effector: per axis 0.051, 0.095 and 0.072 mm, in
    3-D 0.070 mm; the root of the axes' sum would be 0.130).
    """

    count: int  # number of samples
    mean_mm: dict[str, float]  # by axis
    rms_mm: dict[str, float]  # by axis
    sd_mm: dict[str, float]  # by axis
    rms_3d_mm: float  # root mean square of the error's length
    sd_3d_mm: float  # standard deviation of the error's length
    median_3d_mm: float  # of the error's length
    p95_3d_mm: float  # 95 % of the errors are at most this long
    max_3d_mm: float  # the longest


def position_errors(errors_mm: Floats) -> PositionErrors | None:
    """Statistics of errors (n, 3), None without any."""
    if not len(errors_mm):
        return None
    length = np.linalg.norm(errors_mm, axis=1)
    return PositionErrors(
        count=len(errors_mm),
        mean_mm=_by_axis(errors_mm.mean(axis=0)),
        rms_mm=_by_axis(np.sqrt(np.mean(errors_mm**2, axis=0))),
        sd_mm=_by_axis(errors_mm.std(axis=0)),
        rms_3d_mm=_rms(length),
        sd_3d_mm=float(length.std()),
        median_3d_mm=float(np.median(length)),
        p95_3d_mm=float(np.quantile(length, 0.95)),
        max_3d_mm=float(length.max()),
    )


@dataclass(frozen=True)
class RotationErrors:
    """Rotation errors over `count` samples."""

    count: int  # number of samples
    rms_deg: dict[str, float]  # by world axis, of the error's rotation vector
    rms_3d_deg: float  # root mean square of the angle
    sd_3d_deg: float  # standard deviation of the angle
    max_3d_deg: float  # the largest angle


def rotation_errors(rotvecs: Floats) -> RotationErrors | None:
    """Statistics of rotation vectors (n, 3) in rad, None without any."""
    if not len(rotvecs):
        return None
    turns = np.rad2deg(rotvecs)
    angle = np.linalg.norm(turns, axis=1)
    return RotationErrors(
        count=len(turns),
        rms_deg=_by_axis(np.sqrt(np.mean(turns**2, axis=0))),
        rms_3d_deg=_rms(angle),
        sd_3d_deg=float(angle.std()),
        max_3d_deg=float(angle.max()),
    )


@dataclass(frozen=True)
class PixelErrors:
    """Errors of ball centres in the images over `count` detections."""

    count: int  # number of detections
    mean_px: dict[str, float]  # by image axis (u right, v down)
    rms_px: dict[str, float]  # by image axis
    rms_2d_px: float  # root mean square of the error's length
    p95_2d_px: float  # 95 % of the errors are at most this long
    max_2d_px: float  # the longest


def pixel_errors(errors_px: Floats) -> PixelErrors | None:
    """Statistics of errors (n, 2), None without any."""
    if not len(errors_px):
        return None
    length = np.linalg.norm(errors_px, axis=1)
    return PixelErrors(
        count=len(errors_px),
        mean_px=_by_axis(errors_px.mean(axis=0), ("u", "v")),
        rms_px=_by_axis(np.sqrt(np.mean(errors_px**2, axis=0)), ("u", "v")),
        rms_2d_px=_rms(length),
        p95_2d_px=float(np.quantile(length, 0.95)),
        max_2d_px=float(length.max()),
    )


@dataclass(frozen=True)
class Consistency:
    """Whether errors are as large as the reported covariances say."""

    count: int  # errors with a usable covariance
    # share of errors inside their own 95 % ellipsoid; 0.95 is right, less means the covariances
    # promise too much.
    inside_95: float
    # mean of e^T C^-1 e over its dimension; 1 is right, more means the covariances promise too
    # much.
    normalised_squared_error: float


def consistency(errors: Floats, covariances: Floats) -> Consistency | None:
    """Compare errors (n, k) with their covariances (n, k, k); None if none is usable."""
    usable = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(errors).all(axis=1)
    errors, covariances = errors[usable], covariances[usable]
    if len(errors):
        # Scaled to unit diagonal: mm and rad differ by orders of magnitude.
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", covariances), 1e-300))
        errors, covariances = errors / scale, covariances / (scale[:, :, None] * scale[:, None, :])
        positive = np.linalg.eigvalsh(covariances)[:, 0] > 1e-12
        errors, covariances = errors[positive], covariances[positive]
    if not len(errors):
        return None
    squared = squared_mahalanobis(errors, covariances)
    size = errors.shape[1]
    limit = chi_square_quantile(0.95, size)
    return Consistency(len(errors), float(np.mean(squared <= limit)), float(squared.mean() / size))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _by_axis(values: Floats, axes: tuple[str, ...] = AXES) -> dict[str, float]:
    return dict(zip(axes, values.tolist(), strict=True))

"""Where the cameras stand, one by one: equation 3 of the paper.

The board gives a rough pose, the markers refine it. The vector from the camera to a marker, v_c2m,
and the vector from the marker's image to the camera, v_i2c, must be parallel. The paper writes
v_c2m(k) / v_i2c(k) = |v_c2m| / |v_i2c| for k = 1, 2, 3; multiplied out, because a quotient has no
value where a component is zero, and divided by both lengths, that is
v_c2m / |v_c2m| - v_i2c / |v_i2c| = 0: three equations a marker, six unknowns a camera, solved by
Levenberg and Marquardt. The paper gives no errors. Here those of marks, lenses and marker places
travel through the equations (implicit differentiation of their optimum) into one covariance of all
cameras; the standard deviation of the marks comes from their residuals, pooled over the cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.arrays import Floats, rms_length
from measure.errors import CalibrationError
from measure.geometry import skew
from measure.model import Camera, RigFit, RigObservations

MARK_SD_PX = 0.5
"""Of marks by a careful hand, where three a camera do not tell."""
_MIN_SD_PX = 0.02


def fit_rig_by_paper(
    start: tuple[Camera, ...], observations: RigObservations, mark_sd_px: float | None = None
) -> RigFit:
    """Every camera by itself, from three markers or more, beginning at its rough pose."""
    cameras, squares, freedom = [], 0.0, 0.0
    for camera in start:
        located, residuals = _located(camera, observations)
        cameras.append(located)
        worth = located.intrinsics.focal_px / np.linalg.norm(
            observations.markers[observations.marks[camera.name].ids] - located.center, axis=1
        )
        # The variance of the marker places is in the residuals too, but is not the marks'.
        by_places = 2 * float(np.sum((worth * observations.tolerances.marker_mm) ** 2))
        share = max(1 - 6 / residuals.size, 0)
        squares += max(float(np.sum(residuals**2)) - by_places * share, 0)
        freedom += residuals.size - 6
    sd = mark_sd_px or MARK_SD_PX
    if mark_sd_px is None and freedom > 0:
        sd = max(float(np.sqrt(squares / freedom)), _MIN_SD_PX)
    return _with_covariances(tuple(cameras), observations, sd)


def _located(start: Camera, observations: RigObservations) -> tuple[Camera, Floats]:
    """A camera by equation 3, and the residuals (n, 2) px of its marks."""
    marks = observations.marks.get(start.name)
    if marks is None:
        raise CalibrationError(
            f"camera {start.name}: the paper's method needs its markers: give marks.csv or "
            "marker_image"
        )
    if len(marks.ids) < 3:
        raise CalibrationError(
            f"camera {start.name}: the paper's equation 3 needs 3 markers, got {len(marks.ids)}"
        )
    points = observations.markers[marks.ids]
    located = _solve_equation_3(start, points, marks.pixels)
    error = marks.pixels - located.project(points)
    return replace(located, reprojection_rms_px=rms_length(error)), error


def _solve_equation_3(start: Camera, points: Floats, pixels: Floats) -> Camera:
    from scipy.optimize import least_squares

    bearings = start.intrinsics.unproject(pixels)

    def equation_3(unknowns: Floats) -> Floats:
        pose = start.world_from_camera.perturb(unknowns)
        c2m = points - pose.translation
        i2c = pose.rotate(bearings)
        return np.ravel(c2m / np.linalg.norm(c2m, axis=1, keepdims=True) - i2c)

    found = least_squares(
        equation_3, np.zeros(6), method="lm", x_scale=np.repeat([100.0, 0.1], 3), xtol=1e-12
    )
    if not found.success:
        raise CalibrationError(f"camera {start.name}: equation 3 has no optimum: {found.message}")
    return replace(start, world_from_camera=start.world_from_camera.perturb(found.x))


def _sensitivity(camera: Camera, points: Floats, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """How a camera's pose follows marks (6, 2n), lens (6, 12) and its markers (6, 3n)."""
    turn = camera.world_from_camera.rotation
    bearings = camera.intrinsics.unproject(pixels)
    _, by_bearing, pixel_by_lens = camera.intrinsics.project_with_jacobians(bearings)
    by_pixel = turn @ np.linalg.pinv(by_bearing)  # of R b, (n, 3, 2)
    c2m = points - camera.center
    length = np.linalg.norm(c2m, axis=1)[:, None, None]
    unit = c2m[:, :, None] / length
    by_marker = (np.eye(3) - unit @ np.swapaxes(unit, 1, 2)) / length
    J = np.concatenate([-by_marker, skew(bearings @ turn.T)], axis=2).reshape(-1, 6)
    gain = -np.linalg.pinv(J).reshape(6, len(points), 3)
    return (
        -np.einsum("ink,nkj->inj", gain, by_pixel).reshape(6, -1),
        np.einsum("ink,nkj,njl->il", gain, by_pixel, pixel_by_lens),
        np.einsum("ink,nkj->inj", gain, by_marker).reshape(6, -1),
    )


def _with_covariances(
    cameras: tuple[Camera, ...], observations: RigObservations, sd_px: float
) -> RigFit:
    """Marks and lenses are each camera's own; the places of the markers are common to all."""
    from scipy.linalg import block_diag

    own: list[Floats] = []
    common: list[Floats] = []
    for camera in cameras:
        marks, free = observations.marks[camera.name], camera.intrinsics.free
        by_marks, by_lens, by_markers = _sensitivity(
            camera, observations.markers[marks.ids], marks.pixels
        )
        C = camera.intrinsics.covariance
        C = np.zeros((12, 12)) if C is None else C
        # Rows: pose, then the lens parameters themselves, which the poses follow.
        gain = np.concatenate([by_lens, np.eye(12)[free]])
        block = gain @ C @ gain.T
        block[:6, :6] += sd_px**2 * by_marks @ by_marks.T
        own.append(block)
        shift = np.zeros((len(block), observations.markers.size))
        of_marker = (3 * marks.ids[:, None] + np.arange(3)).reshape(-1)
        shift[:6, of_marker] = by_markers * observations.tolerances.marker_mm
        common.append(shift)
    shifts = np.concatenate(common)
    covariance = block_diag(*own) + shifts @ shifts.T
    rows = np.split(np.arange(len(shifts)), np.cumsum([len(block) for block in own])[:-1])
    located = tuple(
        camera.with_covariance(
            covariance[np.ix_(its, its)], camera.intrinsics.free, camera.reprojection_rms_px
        )
        for camera, its in zip(cameras, rows, strict=True)
    )
    return RigFit(located, covariance, sd_px)

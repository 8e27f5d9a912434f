"""What is known beforehand: the scatter of sightings, and what the first calibration states.

The standard deviations of all errors are estimated from the recording and shrunken to usual values:
restricted maximum likelihood by MacKay's (1992, "Bayesian Interpolation", section 4.4) fixed point,
the squares of the estimated random effects over how many of them the data determine. The usual
value counts as a few observations more.

Of the cameras the first calibration's joint covariance is the prior, where it holds one. Else two
variances are estimated with the recording: of the misses in the workspace, px, and of the camera
positions, mm. They differ, because a camera that stands elsewhere and is turned accordingly has
nearly the same image.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.calibration.refining.recording import Track
from measure.estimation.least_squares import root_information
from measure.limits import TINY
from measure.model import Camera

_MAX_LAG_FRAMES = 30
_MIN_CORRELATION = 0.05
_MEDIAN_OF_RAYLEIGH = 1.1774
_USUAL_COUNTS = 4.0  # How many observations a usual variance is worth


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations of the errors, and the correlation of neighbouring frame sets."""

    view_px: float = 0.1  # of a ball's centre in one picture, beyond what the detector states
    constant_px: float = 0.1  # of what stays of that all through a recording, by ball and camera
    correlation: float = 1.0  # number of neighbouring frame sets that are worth one independent one
    image_px: float = 1.0  # by how much the first calibration misses in the workspace
    position_mm: float = 1.0  # by how much its cameras stand elsewhere, by axis

    def differs(self, other: NoiseModel) -> bool:
        """Whether anything differs by more than five per cent."""
        return bool(np.any(np.abs(self._values() / other._values() - 1) > 0.05))

    def towards(self, other: NoiseModel) -> NoiseModel:
        """The geometric mean with another one: damps oscillation between two."""
        return NoiseModel(*np.sqrt(self._values() * other._values()).tolist())

    def _values(self) -> Floats:
        return np.array(astuple(self))


def shrunken_variance(squares: float, determined: float, usual: float) -> float:
    """A variance from the squares of random effects and how many the data determined."""
    return (squares + _USUAL_COUNTS * usual) / (max(determined, 0.0) + _USUAL_COUNTS)


def with_view_noise(
    noise: NoiseModel,
    residuals: dict[str, Floats],
    tracks: dict[str, Track],
    freedom: float,
    least_px: float,
    variance_factor: float,
) -> NoiseModel:
    """The scatter of single views, and its correlation in time, from residuals.

    Args:
        residuals: by camera (n, 2) px.
        freedom: share of the residuals that is not taken up by unknowns.
        least_px: lower bound of a view's standard deviation.
        variance_factor: multiplies the correlation (see `compare_halves`).
    """
    names = list(residuals)
    left = np.concatenate([residuals[name] for name in names])
    stated = np.concatenate([tracks[name].covariance for name in names])
    extra = _extra_px(left, stated, freedom)
    total = {name: tracks[name].covariance + extra**2 * np.eye(2) for name in names}
    return replace(
        noise,
        view_px=max(extra, least_px),
        correlation=variance_factor * _correlation(residuals, total, tracks),
    )


def _extra_px(residuals: Floats, stated: Floats, freedom: float) -> float:
    """What must be added to stated covariances so that the median residual fits."""
    from scipy.optimize import brentq

    variances, axes = np.linalg.eigh(stated)
    squares = np.einsum("nij,ni->nj", axes, residuals) ** 2 / freedom

    def excess(extra: float) -> float:
        lengths = np.sqrt(np.sum(squares / (variances + extra**2), axis=1))
        return float(np.median(lengths)) - _MEDIAN_OF_RAYLEIGH

    return float(brentq(excess, 0.0, 2 * np.sqrt(np.max(squares)))) if excess(0.0) > 0 else 0.0


def _correlation(
    residuals: dict[str, Floats], total: dict[str, Floats], tracks: dict[str, Track]
) -> float:
    """Integrated correlation time in frame sets: 1 + 2 (rho_1 + rho_2 + ...), at least 1."""
    products, counts = np.zeros(_MAX_LAG_FRAMES + 1), np.zeros(_MAX_LAG_FRAMES + 1)
    for name, left in residuals.items():
        track = tracks[name]
        size = np.sqrt(np.einsum("nii->n", total[name]))
        # Clipped, so that one wrong detection does not pass for correlation, or hide it.
        standard = np.clip(left / size[:, None], -2.5, 2.5)
        for ball in np.unique(track.ball):
            mine = track.ball == ball
            line = np.full((int(track.frame[mine].max()) + 1, 2), np.nan)
            line[track.frame[mine]] = standard[mine]
            for lag in range(min(_MAX_LAG_FRAMES + 1, len(line))):
                both = (line[lag:] * line[: len(line) - lag]).reshape(-1)
                products[lag] += np.nansum(both)
                counts[lag] += np.count_nonzero(np.isfinite(both))
    rho = products / np.maximum(counts, 1)
    rho = rho[1:] / max(rho[0], 1e-12)
    faded = np.flatnonzero(rho < _MIN_CORRELATION)
    return float(1 + 2 * np.sum(rho[: faded[0]] if len(faded) else rho))


USUAL_POSITION_MM = 0.5
"""Where cameras usually stand elsewhere than a calibration without a joint covariance says, by
axis (a standard deviation)."""
_USUAL_IMAGE_PX = 0.1  # By how much such a calibration usually misses
_POINTS_PER_SIDE = 4  # Points a side of the grid at which misses are counted


class CameraPrior:
    """A normal distribution of the cameras about the first calibration.

    Attributes:
        joint: the covariance of all cameras together as the first calibration states it, or None:
            then the errors are of several kinds, and the variance of each kind is estimated.
        position: (p, p) with change @ position @ change the squared displacements, mm^2, of
            cameras without a statement.
        image: (p, p) the same of the misses in the workspace, px^2, as if three points were seen.
        stated: (p, p) information about each camera's pose, and about each lens, by itself.
    """

    def __init__(
        self, first: tuple[Camera, ...], points_world: Floats, joint: Floats | None = None
    ) -> None:
        size = sum(len(camera.free) for camera in first)
        self.first = first
        self.joint = joint if joint is not None and joint.shape == (size, size) else None
        self.position, self.image, self.stated = np.zeros((3, size, size))
        row = 0
        for camera in first:
            own = camera.intrinsics.free
            at = slice(row, row + 6 + len(own))
            self.image[at, at] = _misses(camera, points_world)
            pose, lens = camera.pose_covariance, camera.intrinsics.covariance
            turn, way = slice(row, row + 6), slice(row, row + 3)
            if pose is not None and np.all(np.diag(pose) > 0):
                self.stated[turn, turn] = _information(pose)
            else:
                self.position[way, way] = np.eye(3)
            if lens is not None and len(own):
                rest = slice(row + 6, at.stop)
                self.stated[rest, rest] = _information(lens[np.ix_(own, own)])
            row = at.stop

    def change(self, cameras: tuple[Camera, ...]) -> Floats:
        """How far cameras are from the first ones (p,), camera after camera: pose, then lens."""
        both = zip(self.first, cameras, strict=True)
        return np.concatenate([now.difference(first)[first.free] for first, now in both])

    def root(self, noise: NoiseModel) -> Floats:
        """R (p, p) with R^T R the inverse covariance of all poses and free lens parameters."""
        if self.joint is not None:
            return root_information(self.joint, TINY)
        information = self._information(noise)
        scale = np.sqrt(np.diag(information))
        return np.asarray(np.linalg.cholesky(information / scale[:, None] / scale).T * scale)

    def covariance_at(self, noise: NoiseModel) -> Floats:
        """The covariance (p, p) itself."""
        if self.joint is not None:
            return self.joint
        information = self._information(noise)
        scale = 1 / np.sqrt(np.diag(information))
        return np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale

    def _information(self, noise: NoiseModel) -> Floats:
        return np.asarray(
            self.position / noise.position_mm**2 + self.image / noise.image_px**2 + self.stated
        )

    def estimate(self, noise: NoiseModel, change: Floats, posterior: Floats) -> NoiseModel:
        """The noise model with the variances of cameras' errors, unless stated jointly.

        From the cameras' change (p,) and its posterior covariance (p, p).
        """
        if self.joint is not None:
            return noise
        prior = self.covariance_at(noise)

        def estimated(kind: Floats, now: float, usual: float) -> float:
            determined = float(np.sum(kind * (prior - posterior))) / now**2
            squares = float(change @ kind @ change)
            return float(np.sqrt(shrunken_variance(squares, determined, usual**2)))

        return replace(
            noise,
            image_px=estimated(self.image, noise.image_px, _USUAL_IMAGE_PX),
            position_mm=estimated(self.position, noise.position_mm, USUAL_POSITION_MM),
        )


def _misses(camera: Camera, points_world: Floats) -> Floats:
    """Mean squared miss at points, times three: as a matrix on the camera's change."""
    J = np.concatenate(camera.project_with_jacobians(points_world)[2:], axis=2)[:, :, camera.free]
    J = J[np.all(np.isfinite(J), axis=(1, 2))]
    rows = J.reshape(-1, J.shape[2])
    return np.asarray(3 / max(len(J), 1) * rows.T @ rows)


def workspace_grid(points_world: Floats) -> Floats:
    """A grid (n, 3) through the box that points fill."""
    low, high = points_world.min(axis=0), points_world.max(axis=0)
    sides = np.linspace(low, high, _POINTS_PER_SIDE).T
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def _information(covariance: Floats) -> Floats:
    root = root_information(covariance, TINY)
    return np.asarray(root.T @ root)

"""Clock offsets and rolling-shutter times of cameras, from a motion that all of them saw.

An image with a wrong stamp shows the moving body displaced along each ball's path, in proportion to
its speed. All images are fitted together: one pose per instant, and per camera a clock offset and
the readout time of its shutter. The poses are eliminated instant by instant (Schur complement;
Triggs et al. 2000, section 6), which leaves a small system for the clocks. Only differences between
cameras are observable: the median of the offsets is set to 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import RigidTransform, chi_square_quantile, skew
from measure.geometry.normal_equations import symmetric_inverse
from measure.measuring.measurement import Measurement
from measure.measuring.pose_spline import REACH, motion_at
from measure.model import Body, Camera, Pose

_HUBER_SIGMAS = 3.0
_MIN_IMAGE_SPEED_PX_S = 1e-3
_JACKKNIFE_BLOCKS = 8
_PRIOR_SD_S = 10.0  # A weak prior keeps a parameter that is nearly unobservable from diverging
_FARTHEST_S = 3 * _PRIOR_SD_S  # A clock beyond has diverged


@dataclass(frozen=True, eq=False)
class Instant:
    """The observations of one instant, and the motion around it."""

    sightings: PoseObservations  # n ball-views
    cameras: Ints  # (n,) index of the camera
    rows: Floats  # (n,) the ball's image row, from -0.5 at the top to 0.5 at the bottom
    pose: RigidTransform  # at the instant
    velocity: Floats  # (6,) and
    acceleration: Floats  # (6,) in the pose's `perturb` chart, per second and second squared


def linearise(instant: Instant, clocks: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """The observations of an instant near its pose and clocks (c, 2), offsets and readout in s.

    Residuals (n, 2), Jacobian by the pose (n, 2, 6), image velocity (n, 2) in px/s, and the balls'
    centres (n, 3) when their images were taken.
    """
    s = instant.sightings
    lead = s.lead_s + clocks[instant.cameras, 0] + clocks[instant.cameras, 1] * instant.rows
    moved = lead[:, None] * instant.velocity + lead[:, None] ** 2 / 2 * instant.acceleration
    speed = instant.velocity + lead[:, None] * instant.acceleration
    arms = instant.pose.rotate(s.points_body)
    by_pose = np.concatenate([np.broadcast_to(np.eye(3), (len(s), 3, 3)), -skew(arms)], axis=2)
    shift = np.einsum("nij,nj->ni", by_pose, moved)
    points = arms + instant.pose.translation + shift
    pixels, by_point = s.rig.project(points)
    jacobian = by_point @ by_pose
    return s.pixels - pixels, jacobian, np.einsum("nij,nj->ni", jacobian, speed), points


def bias_deviations(instants: Sequence[Instant], clocks: Floats, bias_px: float) -> Floats:
    """Standard deviations (c, 2) in s of the clocks from a constant bias of a camera's detections.

    A bias of `bias_px` resembles a late stamp while the body moves one way, and an early one on the
    way back: it cancels as far as the image velocities sum to zero.
    """
    count = len(clocks)
    totals, squares = np.zeros((count, 2, 2)), np.full((count, 2), 1e-30)
    for instant in instants:
        _, _, flow, _ = linearise(instant, clocks)
        for k, by in enumerate((flow, flow * instant.rows[:, None])):
            np.add.at(totals[:, k], instant.cameras, by)
            np.add.at(squares[:, k], instant.cameras, np.sum(by**2, axis=1))
    return np.asarray(bias_px * np.linalg.norm(totals, axis=2) / squares)


def relative_to_median(offsets_s: Floats, observable: Bools) -> Floats:
    """The matrix (c, c) that gives offsets (c,) relative to their median.

    Only differences are observable. Usually one clock is wrong: relative to the median it has the
    whole offset and the others have none. Those that are not `observable` (c,) stay unchanged.
    """
    matrix, index = np.eye(len(offsets_s)), np.nonzero(observable)[0]
    if len(index):
        order = index[np.argsort(offsets_s[index])]
        middle = order[[(len(order) - 1) // 2, len(order) // 2]]
        for one in middle:
            matrix[index, one] -= 0.5
    return matrix


@dataclass(frozen=True, eq=False)
class Reduced:
    """One instant's normal equations for p parameters, its pose eliminated."""

    normal: Floats  # (p, p)
    right: Floats  # (p,)
    by_residual: Floats  # (n, 2, p) the right side's derivative by the residuals
    chi_square: float  # weighted sum of squared residuals
    degrees: int  # of freedom
    pose: Floats  # (6,) step of the pose alone
    adapts: Floats  # (6, p) how that follows the parameters


def eliminate_pose(residuals: Floats, by_pose: Floats, by_others: Floats, noise: Floats) -> Reduced:
    """Weight n residuals robustly, and solve for the pose as a function of the other parameters."""
    weight, n = robust_weights(residuals, noise), len(residuals)
    pose, others, off = by_pose.reshape(2 * n, 6), by_others.reshape(2 * n, -1), residuals.ravel()
    weighted_pose, weighted = ((weight @ by).reshape(2 * n, -1) for by in (by_pose, by_others))
    inverse = symmetric_inverse(pose.T @ weighted_pose)
    adapts = inverse @ (pose.T @ weighted)
    own = weighted - weighted_pose @ adapts
    square = float(np.einsum("ni,nij,nj->", residuals, weight, residuals))
    step = inverse @ (weighted_pose.T @ off)
    by_residual = own.reshape(n, 2, -1)
    return Reduced(others.T @ own, own.T @ off, by_residual, square, 2 * n - 6, step, adapts)


def reduce_instant(instant: Instant, clocks: Floats, readout: Bools) -> Reduced:
    """Linearise one instant about the clocks (c, 2); only cameras in `readout` (c,) roll."""
    residuals, by_pose, flow, _ = linearise(instant, clocks)
    by_clock = np.zeros((len(residuals), 2, clocks.size))
    rows = np.arange(len(residuals))
    by_clock[rows, :, 2 * instant.cameras] = flow
    rolling = readout[instant.cameras] * instant.rows
    by_clock[rows, :, 2 * instant.cameras + 1] = flow * rolling[:, None]
    return eliminate_pose(residuals, by_pose, by_clock, instant.sightings.noise)


def solve_clocks(
    parts: Sequence[Reduced], clocks: Floats, readout: Bools, bias: Floats
) -> tuple[Floats, Floats]:
    """One Gauss-Newton step (c, 2) for the clocks, and their standard deviations (c, 2).

    Errors of neighbouring frames are correlated (light, edges), so the variances by the residuals
    are compared with a jackknife over blocks of the recording; the larger ones count.

    Args:
        parts: of all instants, linearised about the clocks (c, 2).
        readout: (c,) which cameras' shutters may roll.
        bias: (c, 2) standard deviations from constant errors of the detections.
    """
    normal = sum((p.normal for p in parts), np.zeros_like(parts[0].normal))
    right = sum((p.right for p in parts), np.zeros_like(parts[0].right))
    observable = np.diag(normal) > _MIN_IMAGE_SPEED_PX_S**2
    observable = observable & np.stack([np.ones_like(readout), readout], axis=1).reshape(-1)
    scale = sum(p.chi_square for p in parts) / max(sum(p.degrees for p in parts), 1)
    step, covariance = _constrained(normal, right, observable)
    gauge = np.eye(len(step))
    gauge[::2, ::2] = relative_to_median((clocks.reshape(-1) + step)[::2], observable[::2])
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    variance = np.diag(gauge @ finite @ gauge.T)
    # Rounding makes variances negative where the motion determines next to nothing.
    formal = np.sqrt(np.where(variance >= 0, variance, np.inf) * max(1.0, scale))
    off = _jackknife_steps(parts, normal, right, observable) - step
    blocks = len(off)
    spread = np.sqrt((blocks - 1) * np.mean((off @ gauge.T) ** 2, axis=0))
    sd = np.hypot(np.maximum(formal, spread), np.sqrt(gauge**2 @ bias.reshape(-1) ** 2))
    sd[~observable] = np.inf
    step = gauge @ (clocks.reshape(-1) + step) - clocks.reshape(-1)
    return step.reshape(-1, 2), sd.reshape(-1, 2)


def _jackknife_steps(
    parts: Sequence[Reduced], normal: Floats, right: Floats, observable: Bools
) -> Floats:
    """The steps (b, 2 c), each without one of b blocks of the recording."""
    blocks = np.array_split(np.arange(len(parts)), min(_JACKKNIFE_BLOCKS, len(parts)))
    steps = []
    for block in blocks:
        less = normal - sum(parts[i].normal for i in block)
        steps.append(_constrained(less, right - sum(parts[i].right for i in block), observable)[0])
    return np.stack(steps)


def robust_weights(residuals: Floats, noise: Floats) -> Floats:
    """Inverse covariances (n, 2, 2), less (Huber) for residuals of over three deviations."""
    inverse = np.linalg.inv(noise)
    distance = np.sqrt(np.einsum("ni,nij,nj->n", residuals, inverse, residuals))
    return np.asarray(
        inverse * np.minimum(1.0, _HUBER_SIGMAS / np.maximum(distance, 1e-9))[:, None, None]
    )


def _constrained(normal: Floats, right: Floats, observable: Bools) -> tuple[Floats, Floats]:
    """Solve for the observable parameters, with offsets of zero mean (bordered system)."""
    size = len(right)
    step, covariance = np.zeros(size), np.diag(np.where(observable, 0.0, np.inf))
    index = np.nonzero(observable)[0]
    if not len(index):
        return step, covariance
    level = float(np.max(np.diag(normal)[index])) or 1.0  # 0 if a block held all the motion
    border = np.where(index % 2 == 0, 1.0, 0.0)
    system = np.zeros((len(index) + 1, len(index) + 1))
    system[:-1, :-1] = normal[np.ix_(index, index)] / level
    system[:-1, :-1] += np.eye(len(index)) / (level * _PRIOR_SD_S**2)
    system[-1, :-1] = system[:-1, -1] = border
    inverse = symmetric_inverse(system)
    step[index] = (inverse @ np.append(right[index] / level, 0.0))[:-1]
    covariance[np.ix_(index, index)] = inverse[:-1, :-1] / level
    return step, covariance


_ITERATIONS = 4
_SIGNIFICANT_SIGMAS = 4.0
_MIN_INSTANTS = 5
_MOTION_CONFIDENCE = 0.9999
_EXTRA_PX = 0.3  # Usual systematic error of a detection
_MAX_READOUT_SD_S = 0.008
"""A less certain readout time cannot be separated from the offset and is not estimated."""


@dataclass(frozen=True)
class CameraClock:
    """One camera's clock."""

    camera: str
    offset_s: float  # add this to the camera's time stamps to bring them in line with the others
    offset_sd_s: float  # its standard deviation; infinite if the motion does not determine it
    # time from the first row's exposure to the last row's; negative if from the bottom up; NaN if
    # not estimated.
    readout_s: float
    readout_sd_s: float  # its standard deviation; infinite if the motion does not determine it

    @property
    def offset_visible(self) -> bool:
        """Whether the offset is significant."""
        return abs(self.offset_s) > _SIGNIFICANT_SIGMAS * self.offset_sd_s

    @property
    def rolling(self) -> bool:
        """Whether the readout time is significant."""
        return abs(self.readout_s) > _SIGNIFICANT_SIGMAS * self.readout_sd_s


def estimate_clocks(
    measurements: Iterable[Measurement],
    body: Body,
    cameras: Sequence[Camera],
    readout: bool = True,
    extra_px: float = _EXTRA_PX,
) -> tuple[CameraClock, ...]:
    """Estimate the clock offset and readout time of every camera, in order, while a body moves.

    A camera that saw too little, or a body that stood still, gives infinite standard deviations.
    Without `readout` shutters do not roll; `extra_px` is the systematic error of a detection, in
    its weight and in the uncertainty.
    """
    seen, poses = _sightings(measurements, body, cameras, extra_px)
    if len(seen) < _MIN_INSTANTS:
        return tuple(CameraClock(c.name, 0.0, np.inf, np.nan, np.inf) for c in cameras)
    with_readout = np.full(len(cameras), readout)
    clocks, sd = _estimate(seen, poses, cameras, with_readout, extra_px)
    if np.any(uncertain := with_readout & (sd[:, 1] > _MAX_READOUT_SD_S)):
        clocks, sd = _estimate(seen, poses, cameras, with_readout & ~uncertain, extra_px)
    return tuple(
        CameraClock(
            camera.name,
            float(clocks[i, 0]),
            float(sd[i, 0]),
            float(clocks[i, 1]) if np.isfinite(sd[i, 1]) else float("nan"),
            float(sd[i, 1]),
        )
        for i, camera in enumerate(cameras)
    )


def _estimate(
    seen: Sequence[PoseObservations],
    poses: Sequence[Pose],
    cameras: Sequence[Camera],
    readout: Bools,
    extra_px: float,
) -> tuple[Floats, Floats]:
    """Offsets and readout times (c, 2), and their standard deviations (c, 2)."""
    clocks = np.zeros((len(cameras), 2))
    sd = np.full((len(cameras), 2), np.inf)
    nothing_known = clocks, sd
    for _ in range(_ITERATIONS):
        instants = _instants(seen, poses, cameras)
        try:
            parts = [reduce_instant(instant, clocks, readout) for instant in instants]
        except np.linalg.LinAlgError:  # poses have been led to where nothing is finite
            return nothing_known
        bias = bias_deviations(instants, clocks, extra_px)
        step, sd = solve_clocks(parts, clocks, readout, bias)
        clocks = clocks + step
        # Cameras that contradict each other in their poses leave no offsets that fit.
        if not np.all(np.abs(clocks) <= _FARTHEST_S):
            return nothing_known
        poses = [
            replace(
                pose, world_from_body=pose.world_from_body.perturb(p.pose - p.adapts @ step.ravel())
            )
            for pose, p in zip(poses, parts, strict=True)
        ]
    return clocks, sd


def _sightings(
    measurements: Iterable[Measurement], body: Body, cameras: Sequence[Camera], extra_px: float
) -> tuple[list[PoseObservations], list[Pose]]:
    """What was seen of every pose that two cameras or more see, and these poses."""
    by_name = {camera.name: camera for camera in cameras}
    sightings, poses = [], []
    for m in measurements:
        seen = [v.detection for v in m.views if v.effective and v.detection is not None]
        if m.pose is not None and len({detection.camera for detection in seen}) >= 2:
            poses.append(m.pose)
            sightings.append(PoseObservations.of(seen, body, by_name, m.pose.time_s, extra_px))
    return sightings, poses


def _instants(
    seen: Sequence[PoseObservations], poses: Sequence[Pose], cameras: Sequence[Camera]
) -> list[Instant]:
    names = {camera.name: i for i, camera in enumerate(cameras)}
    heights = np.array([camera.intrinsics.size_wh[1] for camera in cameras])
    out = []
    for s, pose, motion in zip(seen, poses, _derivatives(poses), strict=True):
        index = np.array([names[name] for name in s.rig.names])
        rows = (s.pixels[:, 1] - (heights[index] - 1) / 2) / heights[index]
        out.append(Instant(s, index, rows, pose.world_from_body, *motion))
    return out


def _derivatives(poses: Sequence[Pose]) -> list[tuple[Floats, Floats]]:
    """Velocity and acceleration (6,) at each pose, by a spline through the poses around it.

    Zero where the noise of the poses explains the velocity: it holds no information on clocks.
    """
    gate = chi_square_quantile(_MOTION_CONFIDENCE, 6)
    out = []
    for k, pose in enumerate(poses):
        motion = motion_at(pose, poses[max(k - REACH, 0) : k], poses[k + 1 : k + 1 + REACH])
        velocity = acceleration = np.zeros(6)
        if motion is not None and motion.velocity_covariance is not None:
            noise = motion.velocity_covariance
            if motion.velocity @ np.linalg.solve(noise, motion.velocity) >= gate:
                velocity, acceleration = motion.velocity, motion.acceleration
        out.append((velocity, acceleration))
    return out

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

from measure.arrays import Bools, Floats
from measure.checking.clock_system import Instant, bias_deviations, reduce_instant, solve_clocks
from measure.estimation.pose_fit import PoseObservations
from measure.geometry import chi_square_quantile
from measure.measuring.measurement import Measurement
from measure.measuring.pose_spline import REACH, motion_at
from measure.model import Body, Camera, Pose

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
    """Estimate every camera's clock offset and readout time.

    Args:
        measurements: of one recording in which the body moves, in order of time.
        readout: whether to estimate rolling-shutter times as well.
        extra_px: systematic error of a detection, in its weight and in the uncertainty.

    Returns:
        One clock per camera, in order. A camera that saw too little, or a body that stood still,
        gives infinite standard deviations.
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
    for _ in range(_ITERATIONS):
        instants = _instants(seen, poses, cameras)
        parts = [reduce_instant(instant, clocks, readout) for instant in instants]
        bias = bias_deviations(instants, clocks, extra_px)
        step, sd = solve_clocks(parts, clocks, readout, bias)
        clocks = clocks + step
        poses = [
            replace(pose, world_from_body=pose.world_from_body.perturb(p.pose_step(step)))
            for pose, p in zip(poses, parts, strict=True)
        ]
    return clocks, sd


def measured_instants(
    measurements: Iterable[Measurement], body: Body, cameras: Sequence[Camera]
) -> list[Instant]:
    """The observations of all instants with a pose, in order of time, and the motion there."""
    return _instants(*_sightings(measurements, body, cameras, _EXTRA_PX), cameras)


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

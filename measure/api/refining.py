"""Refining a calibration from the moving balls themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.calibration import Refinement, RefineSettings
from measure.host import Registry
from measure.session import Calibration, read_calibration

LOOSE_WORLD = (
    "the first calibration does not say how its cameras' errors hang together, so the world frame "
    "may have moved while the cameras were sharpened against each other: do not trust absolute "
    "positions to better than that calibration's; `measure calibrate` with its default method says"
)


@dataclass(frozen=True, eq=False)
class RefineResult:
    """A refined calibration and how it came about.

    Attributes:
        calibration: the refined cameras.
        refinement: residuals, clocks, ball centres.
        expected_mm: error of the body's position expected from the calibration alone, before and
            after, as the covariances have it; NaN where there was none before.
        notes: reasons to doubt it, in words.
    """

    calibration: Calibration
    refinement: Refinement
    expected_mm: tuple[float, float]
    notes: tuple[str, ...] = ()


def refine(
    session: Path | str,
    registry: Registry,
    profile: str = "precise",
    settings: RefineSettings | None = None,
    calibration: Path | str | None = None,
    progress: Callable[[int, int | None], None] | None = None,
) -> RefineResult:
    """Measure a session and refine its cameras by bundle adjustment over it.

    Args:
        session: the session folder.
        registry: where the plugins come from.
        profile: how to measure, by name or TOML file.
        settings: what may change, and how far.
        calibration: first calibration, if not the session's own.
        progress: told how many frame sets are measured, and of how many.

    Raises:
        CalibrationError: too little motion, or nothing to hold on to.
        SessionError, PluginError, ConfigError: as when measuring.
    """
    from measure.api.measuring import measure_session
    from measure.api.profiles import load_profile
    from measure.calibration import body_pose_sd, recording_of, refine_rig
    from measure.measuring import Measurement
    from measure.session import open_session

    measured: list[Measurement] = []
    with open_session(session, calibration=calibration) as opened:
        for _, measurement in measure_session(opened, load_profile(profile), registry):
            measured.append(measurement)
            if progress is not None:
                progress(len(measured), None)
        recording = recording_of(measured, opened.body)
        joint = _joint_covariance(opened.calibration_path)
        refinement = refine_rig(opened.cameras, opened.body, recording, settings, joint)
        picked = np.unique(np.linspace(0, len(recording.times_s) - 1, 20).astype(int))
        poses = [recording.world_from_body[int(i)] for i in picked]
        before, _ = body_pose_sd(opened.cameras, opened.body, poses)
        after, _ = body_pose_sd(
            refinement.cameras, opened.body, poses, refinement.covariance, refinement.columns
        )
        known = all(camera.pose_covariance is not None for camera in opened.cameras)
    first = float(np.sqrt(np.mean(before**2))) if known else float("nan")
    expected = (first, float(np.sqrt(np.mean(after**2))))
    notes = () if joint is not None else (LOOSE_WORLD,)
    values = _provenance(str(session), refinement, expected) | {"notes": list(notes)}
    return RefineResult(Calibration(refinement.cameras, values), refinement, expected, notes)


def _joint_covariance(path: Path) -> Floats | None:
    """The covariance of all cameras together, where the first calibration holds it."""
    values = read_calibration(path).provenance.get("joint_covariance")
    return None if values is None else np.asarray(values, dtype=np.float64)


def _provenance(
    session: str, refinement: Refinement, expected_mm: tuple[float, float]
) -> dict[str, object]:
    return {
        "refined_from": session,
        "frame_sets": refinement.frames,
        "clock_offsets_s": refinement.clock_offsets_s,
        "clock_sds_s": refinement.clock_sds_s,
        "ball_centers_mm": refinement.centers,
        "ball_center_sds_mm": refinement.center_sds,
        "noise_factor": refinement.noise_factor,
        "body_position_sd_mm": expected_mm[1],
        "joint_covariance": refinement.covariance,
    }

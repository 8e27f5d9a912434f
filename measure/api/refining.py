"""Refining a calibration from the moving balls themselves."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from measure.api.measuring import calibrated_pipeline
from measure.api.profiles import load_profile
from measure.arrays import Floats
from measure.calibration import RefinedRig, RefineSettings, refine_measured, rough_cameras
from measure.host import Registry
from measure.measuring import Measurement, Profile
from measure.model import Body
from measure.processes import Progress
from measure.session import Calibration, Session, clock_values, open_session, read_calibration

_log = logging.getLogger(__name__)

_ANY_PX = 100.0
"""Displacement of cameras, and of balls in them, from which a pose is flagged while refining."""

LOOSE_WORLD = (
    "the first calibration does not say how its cameras' errors hang together (`measure calibrate` "
    "with its default method does), so the world frame may have moved a little while the cameras "
    "were sharpened against each other: do not trust absolute positions beyond that calibration's"
)


@dataclass(frozen=True, eq=False)
class RefineResult:
    """A refined calibration and how it came about."""

    calibration: Calibration
    rig: RefinedRig
    body: Body  # with its balls where the recording puts them, within the tolerance, and as large
    notes: tuple[str, ...] = ()


def refine(
    session: Path | str,
    registry: Registry,
    profile: str = "precise",
    settings: RefineSettings | None = None,
    calibration: Path | str | None = None,
    progress: Progress | None = None,
) -> RefineResult:
    """Measure a session and refine its cameras by bundle adjustment over it.

    Args:
        profile: how to measure, by name or TOML file.
        settings: what may change, and how far.
        calibration: first calibration, if not the session's own.
        progress: called with how many frame sets are measured, and of how many.

    Raises:
        CalibrationError: too little motion, or a result that is worse than the first calibration.
        SessionError, PluginError, ConfigError: as when measuring.
    """
    chosen = lenient(load_profile(profile))
    with open_session(session, calibration=calibration) as opened:
        joint = joint_covariance(opened)
        given = (opened.cameras, opened.body)
        measured, sized = measure_all(opened, chosen, registry, progress)
        rough = rough_cameras(*given, measured, settings, joint)
        if rough is not None:
            _log.warning("the cameras disagree much: measuring again with roughly refined ones")
            again = replace(opened, cameras=rough)
            measured, sized = measure_all(again, chosen, registry, progress)
        rig = refine_measured(*given, measured, settings, joint)
        clocks = clock_values(opened.clock_digest, _shifts(rig, opened.clock_shifts_s))
    notes = rig.verdict.notes + (() if rig.refinement.world_held else (LOOSE_WORLD,))
    values = _provenance(str(session), rig) | clocks | {"notes": list(notes)}
    refined = _with_centers(sized, rig.refinement.centers)
    return RefineResult(Calibration(rig.refinement.cameras, values), rig, refined, notes)


def joint_covariance(opened: Session) -> Floats | None:
    """The covariance of all cameras together, where their calibration holds it."""
    known = read_calibration(opened.calibration_path).provenance.get("joint_covariance")
    return None if known is None else np.asarray(known, dtype=np.float64)


def lenient(profile: Profile) -> Profile:
    """The profile without flags for displaced cameras: refining corrects those."""
    if profile.tracking == "predictive":
        profile = profile.with_setting("tracking", "view_bias_px", _ANY_PX)
    if profile.solver == "contours":
        profile = profile.with_setting("solver", "max_shift_px", _ANY_PX)
    return profile


def measure_all(
    opened: Session, profile: Profile, registry: Registry, progress: Progress | None
) -> tuple[list[Measurement], Body]:
    """Every frame set measured, and the body with the radii that its outlines show."""
    pipeline, measured = calibrated_pipeline(opened, profile, registry), []
    for measurement in pipeline.measure(opened.frame_sets()):
        measured.append(measurement)
        if progress is not None:
            progress(len(measured), None)
    return measured, pipeline.body


def _with_centers(sized: Body, centers: Floats) -> Body:
    """The body to write: what is known of its radii becomes their tolerance."""
    sd_mm = float(np.sqrt(np.mean(np.diag(sized.radius_covariance))))
    return replace(sized.with_centers(centers), radius_tolerance_mm=sd_mm)


def _shifts(rig: RefinedRig, before: Mapping[str, float]) -> dict[str, float]:
    """What to add to the stamps as recorded, by camera."""
    shifts = dict(before)
    if rig.clocks_applied:
        for clock in rig.clocks:
            shifts[clock.camera] = shifts.get(clock.camera, 0.0) + clock.offset_s
    return shifts


def _provenance(session: str, rig: RefinedRig) -> dict[str, object]:
    refinement, verdict = rig.refinement, rig.verdict
    clocks = {c.camera: c for c in rig.clocks if np.isfinite(c.offset_sd_s)}
    return {
        "refined_from": session,
        "frame_sets": refinement.frames,
        "clock_offsets_s": {name: clock.offset_s for name, clock in clocks.items()},
        "clock_sds_s": {name: clock.offset_sd_s for name, clock in clocks.items()},
        "clocks_applied": rig.clocks_applied,
        "ball_centers_mm": refinement.centers,
        "ball_center_sds_mm": refinement.center_sds,
        "view_scatter_px": refinement.noise.view_px,
        "constant_scatter_px": refinement.noise.constant_px,
        "camera_position_sd_mm": list(verdict.camera_sd_mm),
        "held_out_px": list(verdict.held_out_px),
        "surprise": verdict.surprise,
        "body_position_sd_mm": list(verdict.body_sd_mm),
        "joint_covariance": refinement.covariance,
    }

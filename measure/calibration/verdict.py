"""The verdict on a calibrated rig, as numbers and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats
from measure.calibration.extrinsics import JointRigFit, fit_rig
from measure.calibration.findings import (
    MAX_STRETCH,
    Workspace,
    accuracy_findings,
    board_findings,
    disagreement_findings,
    lens_findings,
    mark_findings,
    plausibility,
    workspace_of,
    zoom_findings,
    zoomed_cameras,
)
from measure.calibration.intrinsics import FOLDS
from measure.calibration.procedure import RigCalibration
from measure.checking import Finding, Level, worst_first
from measure.errors import CalibrationError
from measure.estimation.expected_accuracy import body_pose_sd
from measure.geometry import Rays, RigidTransform, nearest_point
from measure.limits import SIGNIFICANT_SIGMAS
from measure.model import Body, Camera, Doubt, MarkerObservation, RigObservations
from measure.session import JOINT_COVARIANCE


@dataclass(frozen=True, eq=False)
class Verdict:
    """How good a calibration is."""

    workspace: Workspace
    # (27,) expected error of the body's position across the box, 3-D, one standard deviation, from
    # the calibration alone.
    position_sd_mm: Floats
    rotation_sd_deg: Floats  # (27,) the same for its rotation
    # RMS of marks kept out of the fit, median of a waved body's sightings; NaN if there are none.
    held_out_px: float
    held_out_mm: float  # the same at the markers
    # size of the marker field as the boards see it, over its stated size; NaN unless both are
    # there.
    scale: float
    # the three worst board views of each camera: name and RMS in px.
    worst_views: dict[str, list[tuple[str, float]]]
    findings: tuple[Finding, ...]  # everything a user should know, the worst first

    @property
    def trustworthy(self) -> bool:
        """Whether nothing is wrong."""
        return all(f.level is not Level.WRONG for f in self.findings)


def judge(rig: RigCalibration, body: Body, floor_z_mm: float | None = None) -> Verdict:
    """Judge a calibration over the workspace its markers (or cameras) enclose.

    The floor is at z = 0 if none is stated and all markers stand above that.
    """
    markers = rig.markers.points
    workspace = workspace_of(rig.cameras, markers if len(markers) else rig.around)
    if floor_z_mm is None and len(markers) and markers[:, 2].min() >= 0:
        floor_z_mm = 0.0
    poses = [RigidTransform(np.eye(3), point) for point in workspace.grid()]
    joint = rig.joint if rig.fit is None else rig.fit.covariance
    position, rotation = body_pose_sd(rig.cameras, body, poses, joint)
    held_out_px, held_out_mm = _held_out(rig)
    scale, scale_findings = _scale(rig)
    findings = plausibility(rig.cameras, workspace, floor_z_mm)
    zooms = zoomed_cameras(rig)
    apart = mark_findings(rig) + disagreement_findings(rig)
    findings += zoom_findings(zooms) + [f for f in apart if f.camera not in zooms]
    findings += scale_findings
    findings += board_findings(rig) + lens_findings(rig)
    findings += accuracy_findings(position)
    return Verdict(
        workspace,
        position,
        np.rad2deg(rotation),
        held_out_px,
        held_out_mm,
        scale,
        {name: _worst(rig, name) for name in rig.lenses},
        worst_first(findings),
    )


def _held_out(rig: RigCalibration) -> tuple[float, float]:
    """Marks kept out of the joint fit in turn, and missed by how much: another is not repeated."""
    if not isinstance(rig.fit, JointRigFit) or not rig.observations.marks:
        return float("nan"), float("nan")
    squares_px, squares_mm, count = 0.0, 0.0, 0
    for fold in range(FOLDS):
        kept, left = _split(rig.observations.marks, fold)
        try:
            fit = fit_rig(
                rig.cameras_before,
                replace(rig.observations, marks=kept),
                rig.fit.corner_sd_px,
                rig.fit.mark_sd_px,
            )
        except CalibrationError:
            return float("nan"), float("nan")
        for camera in fit.cameras:
            marks = left.get(camera.name)
            if marks is None or not len(marks.ids):
                continue
            offset = fit.state.values.get(f"offsets {camera.name}", np.zeros(2))
            points = rig.observations.markers[marks.ids]
            lengths = np.linalg.norm(marks.pixels - offset - camera.project(points), axis=1)
            worth = np.linalg.norm(points - camera.center, axis=1) / camera.intrinsics.focal_px
            squares_px += float(np.sum(lengths**2))
            squares_mm += float(np.sum((lengths * worth) ** 2))
            count += len(lengths)
    return float(np.sqrt(squares_px / count)), float(np.sqrt(squares_mm / count))


def _split(
    marks: Mapping[str, MarkerObservation], fold: int
) -> tuple[dict[str, MarkerObservation], dict[str, MarkerObservation]]:
    kept, left = {}, {}
    for name, seen in marks.items():
        out = np.arange(len(seen.ids)) % FOLDS == fold
        kept[name] = replace(seen, ids=seen.ids[~out], pixels=seen.pixels[~out])
        left[name] = replace(seen, ids=seen.ids[out], pixels=seen.pixels[out])
    return kept, left


def _scale(rig: RigCalibration) -> tuple[float, list[Finding]]:
    """The marker field's size as cameras placed by their boards alone see it, if those count."""
    seen, by_boards = rig.observations, rig.fit is not None and rig.fit.corner_sd_px is not None
    if not (by_boards and seen.boards and seen.marks):
        return float("nan"), []
    boards_only = tuple(c for c in rig.cameras_before if c.name in seen.boards)
    places = _triangulated(boards_only, seen)
    if len(places) < 4:
        return float("nan"), []
    ids = sorted(places)
    there, stated = np.stack([places[i] for i in ids]), seen.markers[ids]
    a, b = there - there.mean(axis=0), stated - stated.mean(axis=0)
    scale = float(np.sqrt(np.sum(a**2) / np.sum(b**2)))
    _, misfit = Rotation.align_vectors(a, scale * b)
    sd = float(misfit / np.sqrt((3 * len(ids) - 7) * np.sum(b**2)))
    if abs(scale - 1) > max(SIGNIFICANT_SIGMAS * sd, MAX_STRETCH):
        text = Doubt("sizes-disagree", times=scale, sd=sd)
        return scale, [Finding(Level.WEAK, "boards", text)]
    return scale, []


def _triangulated(cameras: tuple[Camera, ...], observations: RigObservations) -> dict[int, Floats]:
    rays: dict[int, list[tuple[Floats, Floats]]] = {}
    for camera in cameras:
        marks = observations.marks.get(camera.name)
        if marks is None:
            continue
        seen = camera.rays(marks.pixels)
        for number, origin, direction in zip(marks.ids, seen.origins, seen.directions, strict=True):
            rays.setdefault(int(number), []).append((origin, direction))
    return {
        number: nearest_point(Rays(np.stack([o for o, _ in r]), np.stack([d for _, d in r])))
        for number, r in rays.items()
        if len(r) >= 2
    }


def _worst(rig: RigCalibration, name: str) -> list[tuple[str, float]]:
    lens = rig.lenses[name]
    rms = lens.fit.view_rms_px()
    order = np.argsort(-rms)[:3]
    return [(lens.views.views[i].source, float(rms[i])) for i in order]


def judgement_lines(rig: RigCalibration, verdict: Verdict) -> list[str]:
    """The verdict in lines of text: what was measured, what was noticed, what it is good for."""
    lines = []
    for name, views in verdict.worst_views.items():
        worst = ", ".join(f"{source} {rms:.3f} px" for source, rms in views)
        lines.append(f"worst board views of {name}: {worst}")
    if np.isfinite(verdict.held_out_px):
        px, mm = verdict.held_out_px, verdict.held_out_mm
        what, kind = ("marks", "RMS") if rig.observations.marks else ("frame sets", "(median)")
        lines.append(f"{what} kept out of the fit are missed by {px:.2f} px ({mm:.3f} mm) {kind}")
    if rig.disagreement_mm:
        apart = ", ".join(f"{name} {mm:.2f} mm" for name, mm in rig.disagreement_mm.items())
        lines.append(f"board and markers disagree by: {apart}")
    if np.isfinite(verdict.scale):
        lines.append(f"the marker field is {verdict.scale:.4f} times its stated size by the boards")
    lines += [str(finding) for finding in verdict.findings]
    mean = float(np.sqrt(np.mean(verdict.position_sd_mm**2)))
    lines.append(
        f"expected body position error {mean:.3f} mm (worst {verdict.position_sd_mm.max():.3f} mm, "
        "one standard deviation) over the workspace"
    )
    if not verdict.trustworthy:
        lines.append("DO NOT TRUST this calibration: see what is wrong above")
    return lines


def provenance(rig: RigCalibration, verdict: Verdict, capture: str) -> dict[str, Any]:
    """The values of `[provenance]` in `calibration.toml`."""
    fit = rig.fit
    return {
        "capture": capture,
        "method": rig.method,
        "corner_sd_px": None if fit is None else fit.corner_sd_px,
        "mark_sd_px": None if fit is None else fit.mark_sd_px,
        "marker_tolerance_mm": rig.tolerances.marker_mm,
        "board_tolerance_mm": rig.tolerances.board_mm,
        "board_tolerance_deg": rig.tolerances.board_deg,
        "judgement": {
            "trustworthy": verdict.trustworthy,
            "workspace_center_mm": verdict.workspace.center,
            "workspace_half_mm": verdict.workspace.half,
            "body_position_sd_mm": float(np.sqrt(np.mean(verdict.position_sd_mm**2))),
            "body_position_sd_worst_mm": float(verdict.position_sd_mm.max()),
            "body_rotation_sd_deg": float(np.sqrt(np.mean(verdict.rotation_sd_deg**2))),
            "held_out_px": _finite(verdict.held_out_px),
            "held_out_mm": _finite(verdict.held_out_mm),
            "scale_of_markers_by_boards": _finite(verdict.scale),
            "board_marker_disagreement_mm": dict(rig.disagreement_mm) or None,
            "worst_views_px": {n: dict(v) for n, v in verdict.worst_views.items()} or None,
            "findings": [str(finding) for finding in verdict.findings],
        },
        JOINT_COVARIANCE: None if fit is None else fit.covariance,
        "lenses": {name: _lens_values(rig, name) for name in rig.lenses} or None,
    }


def _lens_values(rig: RigCalibration, name: str) -> dict[str, Any]:
    lens = rig.lenses[name]
    return {
        "model": lens.model.name,
        "free": lens.model.parameters,
        "corner_rule": lens.corner_rule,
        "views": len(lens.views.views),
        "rms_px": lens.fit.rms_px,
        "held_out_px": lens.held_out_px[lens.model.name],
        "covered_share": lens.views.covered_share,
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def camera_rows(cameras: Sequence[Camera]) -> list[tuple[str, float, float, float, float | None]]:
    """Per camera: name, focal length px, sd in mm and deg (NaN if not stated), RMS px."""
    rows = []
    for camera in cameras:
        P = camera.pose_covariance
        position, rotation = float("nan"), float("nan")
        if P is not None:
            position = float(np.sqrt(np.trace(P[:3, :3])))
            rotation = float(np.rad2deg(np.sqrt(np.trace(P[3:, 3:]))))
        rms = camera.reprojection_rms_px
        rows.append((camera.name, camera.intrinsics.focal_px, position, rotation, rms))
    return rows

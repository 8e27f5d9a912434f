"""What a user should know about a rig's marks, boards and lenses."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats
from measure.calibration.judgement import Finding, residual_findings
from measure.calibration.procedure import RigCalibration
from measure.calibration.sights import MarkSight
from measure.calibration.starts import mm_per_px
from measure.model import Camera

_LEAST_COVERAGE = 0.4
_NOTED_DISAGREEMENT_MM = 0.5
_STANDS_OUT = 3.0
"""A camera whose board and markers disagree by so many times what the others' do stands out."""


def mark_findings(rig: RigCalibration) -> list[Finding]:
    """Marks that miss, and markers that were left out."""
    findings: list[Finding] = []
    for camera in rig.cameras:
        marks = rig.sights.marks.get(camera.name)
        if marks is not None:
            residuals = _mark_residuals(rig, camera, marks)
            worth = mm_per_px(camera, rig.sights.markers[marks.ids])
            names = [rig.markers.names[i] for i in marks.ids]
            findings += residual_findings(camera.name, residuals, worth, names)
        for name, reason in sorted(_doubtful(rig, camera.name).items()):
            findings.append(Finding("note", camera.name, f"marker {name} left out: {reason}"))
    return findings


def disagreement_findings(rig: RigCalibration) -> list[Finding]:
    """Boards and markers that disagree: of all cameras alike, or of one that stands out.

    Boards held less exactly than stated disagree a little everywhere; the fit then gives them less
    say. One camera that disagrees while the others do not has moved between its two pictures.
    """
    findings = []
    for name, apart in rig.disagreement_mm.items():
        others = [mm for other, mm in rig.disagreement_mm.items() if other != name]
        usual = float(np.median(others)) if others else 0.0
        if apart > max(_NOTED_DISAGREEMENT_MM, _STANDS_OUT * usual):
            than = f" (the others by {usual:.2f} mm)" if others else ""
            text = (
                f"board and markers disagree by {apart:.2f} mm{than}: the camera or the board "
                "moved between the two pictures, or the stated board pose is wrong; take both again"
            )
            findings.append(Finding("alarm", name, text))
        elif apart > _NOTED_DISAGREEMENT_MM:
            text = (
                f"board and markers disagree by {apart:.2f} mm: one of the two was not held exactly"
            )
            findings.append(Finding("warning", name, text))
    return findings


def _mark_residuals(rig: RigCalibration, camera: Camera, marks: MarkSight) -> Floats:
    if rig.fit is not None and camera.name in rig.fit.mark_residuals:
        return rig.fit.mark_residuals[camera.name]
    return marks.pixels - camera.project(rig.sights.markers[marks.ids])


def _doubtful(rig: RigCalibration, camera: str) -> dict[str, str]:
    found = rig.found.get(camera)
    if found is None:
        return {}
    marked = {rig.markers.names[i] for i in rig.sights.marks[camera].ids}
    return {name: reason for name, reason in found.doubtful.items() if name not in marked}


def lens_findings(rig: RigCalibration) -> list[Finding]:
    """What the lenses' views lack, and why freer lenses were refused."""
    findings = []
    for name, lens in rig.lenses.items():
        if lens.views.covered_share < _LEAST_COVERAGE:
            text = (
                f"the board was shown in {lens.views.covered_share:.0%} of the image only; "
                "the lens "
                "is extrapolated elsewhere"
            )
            findings.append(Finding("warning", name, text))
        if lens.views.mirrored:
            text = (
                f"{lens.views.mirrored} pictures show the board mirrored, or its back; if "
                "the camera "
                "is in mirror (selfie) mode switch that off"
            )
            findings.append(Finding("warning", name, text))
        for picture, reason in lens.views.left_out.items():
            findings.append(Finding("note", name, f"{picture} left out: {reason}"))
        findings += [Finding("note", name, reason) for reason in lens.reasons]
    return findings

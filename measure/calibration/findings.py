"""What a user should know of a rig, its marks, boards and lenses, and where bodies will be."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.calibration.procedure import RigCalibration
from measure.calibration.starts import ZOOMED, ZOOMED_CURE, mark_rms, mm_per_px, zoomed
from measure.checking import Finding, Level
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, nearest_point
from measure.limits import CLEAR_RATIO
from measure.model import Camera, Doubt


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where bodies will be measured: the box `center` +- `half` (3,) mm."""

    center: Floats
    half: Floats

    def grid(self) -> Floats:
        """Points (27, 3) across the box."""
        steps = np.linspace(-1, 1, 3)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return self.center + offsets * self.half


def workspace_of(cameras: tuple[Camera, ...], points: Floats) -> Workspace:
    """The inner half of the marker field (or of the board corners (n, 3) in view).

    Without points: 100 mm around where the cameras' axes meet; DegenerateGeometryError if they do
    not.
    """
    if len(points) >= 4 and np.all(np.ptp(points[:, :2], axis=0) > 0):
        low, high = points.min(axis=0), points.max(axis=0)
        return Workspace((low + high) / 2, np.maximum((high - low) / 4, 10.0))
    axes = Rays(
        np.stack([c.center for c in cameras]),
        np.stack([c.world_from_camera.rotation[:, 2] for c in cameras]),
    )
    return Workspace(nearest_point(axes), np.full(3, 50.0))


SUB_MM_SD_MM = 0.3
"""A body position known worse than this (one standard deviation) does not support sub-mm."""
_MAX_MARK_PX = 1.5
_MAX_MARK_MM = 0.35
_SAME_PLACE_MM = 5.0
MAX_STRETCH = 0.002  # Of a board: half of it is an error of all lengths
_MAX_BOW_MM = 0.4  # 1 mm in a board of 225 mm makes 0.15 mm of the pose's error
_MIN_COVERED_SHARE = 0.4
_NOTED_DISAGREEMENT_MM = 0.5
_ZOOM_LEAVES = 0.4
"""Disagreement from which a zoom is thought of, and the share of it, in px, that one leaves. Boards
that were moved by millimetres leave more."""


def mark_findings(rig: RigCalibration) -> list[Finding]:
    """Marks that miss, and markers that were left out."""
    findings: list[Finding] = []
    for camera in rig.cameras:
        marks, found = rig.observations.marks.get(camera.name), rig.found.get(camera.name)
        names: list[str] = []
        if marks is not None:
            residuals = marks.pixels - camera.project(rig.observations.markers[marks.ids])
            if rig.fit is not None:
                residuals = rig.fit.mark_residuals.get(camera.name, residuals)
            worth = mm_per_px(camera, rig.observations.markers[marks.ids])
            names = [rig.markers.names[i] for i in marks.ids]
            findings += residual_findings(camera.name, residuals, worth, names)
        for name, reason in sorted(found.doubtful.items()) if found else ():
            if name not in names:
                text = Doubt("marker-left-out", marker=name, reason=reason)
                findings.append(Finding(Level.NOTE, "marks", text, camera.name))
    return findings


def zoomed_cameras(rig: RigCalibration) -> dict[str, float]:
    """Cameras whose board and markers disagree, but for so large pictures."""
    out, seen = {}, rig.observations
    for start in rig.cameras_before:
        if rig.disagreement_mm.get(start.name, 0.0) > SUB_MM_SD_MM:
            marks = seen.marks[start.name]
            zoom, left = zoomed(start, seen.boards[start.name], rig.markers, marks)
            if left < _ZOOM_LEAVES * mark_rms(start, rig.markers.points, marks):
                out[start.name] = zoom
    return out


def zoom_findings(zooms: Mapping[str, float]) -> list[Finding]:
    """A line on them."""
    if not zooms:
        return []
    zoom = float(np.median(list(zooms.values())))
    text = f"{', '.join(zooms)}: {ZOOMED.format(zoom=zoom)}: {ZOOMED_CURE}"
    return [Finding(Level.WRONG, "lens", text, code="zoomed")]


def disagreement_findings(rig: RigCalibration) -> list[Finding]:
    """Boards and markers that disagree: of all cameras alike, or of one that stands out.

    Boards held less exactly than stated disagree a little everywhere, and the fit weights them
    accordingly. One camera that disagrees while the others do not has moved between its two
    pictures.
    """
    findings = []
    for name, apart in rig.disagreement_mm.items():
        others = [mm for other, mm in rig.disagreement_mm.items() if other != name]
        usual = float(np.median(others)) if others else 0.0
        if apart > max(_NOTED_DISAGREEMENT_MM, CLEAR_RATIO * usual):
            than = f" (the others by {usual:.2f} mm)" if others else ""
            text = Doubt("moved-between", apart_mm=apart, than=than)
            findings.append(Finding(Level.WRONG, "boards", text, name))
        elif apart > _NOTED_DISAGREEMENT_MM:
            text = Doubt("not-held-exactly", apart_mm=apart)
            findings.append(Finding(Level.WEAK, "boards", text, name))
    return findings


def board_findings(rig: RigCalibration) -> list[Finding]:
    """Lines on a board that has other numbers, was stretched or is not flat."""
    findings = list[Finding]()
    if rig.first_marker is not None:
        text = Doubt("first-marker", number=str(rig.first_marker))
        findings.append(Finding(Level.NOTE, "boards", text))
    if rig.shape is None:
        return findings
    (share, *bows), (sd, *bow_sds) = rig.shape.seen, rig.shape.sds
    if share:
        long, short = ("y", "x") if share > 0 else ("x", "y")
        share, half = abs(share), abs(share) / 2
        text = Doubt("stretched-board", share=share, sd=sd, long=long, short=short, half=half)
        level = Level.WRONG if share > MAX_STRETCH else Level.WEAK
        findings.append(Finding(level, "boards", text))
    bowed = [
        f"{abs(mm):.2f} +- {mm_sd:.2f} mm along {axis}"
        for mm, mm_sd, axis in zip(bows, bow_sds, "xy", strict=True)
        if mm
    ]
    if bowed:
        text = Doubt("bowed-board", bowed=" and ".join(bowed))
        level = Level.WRONG if np.max(np.abs(bows)) > _MAX_BOW_MM else Level.WEAK
        findings.append(Finding(level, "boards", text))
    return findings


def lens_findings(rig: RigCalibration) -> list[Finding]:
    """What the lenses' views lack, and why freer lenses were refused."""
    findings = list[Finding]()
    for name, lens in rig.lenses.items():
        if lens.views.covered_share < _MIN_COVERED_SHARE:
            text = Doubt("lens-extrapolated", share=lens.views.covered_share)
            findings.append(Finding(Level.WEAK, "lens", text, name))
        if lens.views.mirrored:
            text = Doubt("board-mirrored", pictures=lens.views.mirrored)
            findings.append(Finding(Level.WEAK, "lens", text, name))
        if copies := sum(view.twice for view in lens.views.views):
            text = Doubt("two-boards", pictures=copies, looked=len(lens.views.views))
            findings.append(Finding(Level.WEAK, "boards", text, name))
        kinds = defaultdict[str, list[str]](list)
        for picture, (kind, _) in lens.views.left_out.items():
            kinds[kind].append(picture)
        for kind, pictures in kinds.items():
            first, much = pictures[0], lens.views.left_out[pictures[0]][1]
            which = f"{first} left out: {kind}" + (f" ({much})" if much else "")
            if len(pictures) > 1:
                which = f"{len(pictures)} pictures left out, {kind}; first {first}"
            findings.append(Finding(Level.NOTE, "lens", which, name, code="pictures-left-out"))
        findings += [
            Finding(Level.NOTE, "lens", one, name, code="lens-model") for one in lens.reasons
        ]
    return findings


def plausibility(
    cameras: tuple[Camera, ...], workspace: Workspace, floor_z_mm: float | None
) -> list[Finding]:
    """Cameras under the floor, looking away, or standing in one another."""
    wrong: list[tuple[str, Doubt]] = []
    for camera in cameras:
        if floor_z_mm is not None and camera.center[2] < floor_z_mm:
            under_mm = floor_z_mm - camera.center[2]
            text = Doubt("under-the-floor", under_mm=under_mm, floor_mm=floor_z_mm)
            wrong.append((camera.name, text))
        image = camera.project(workspace.center[None])
        if not bool(camera.intrinsics.contains(image)[0]):
            wrong.append((camera.name, Doubt("looks-away")))
    for i, a in enumerate(cameras):
        for b in cameras[i + 1 :]:
            apart = float(np.linalg.norm(a.center - b.center))
            if apart < _SAME_PLACE_MM:
                text = Doubt("cameras-in-one-place", apart_mm=apart, other=a.name)
                wrong.append((b.name, text))
    return [Finding(Level.WRONG, "cameras", text, name) for name, text in wrong]


def residual_findings(
    name: str, residuals: Floats, mm_per_px: float, names: list[str]
) -> list[Finding]:
    """Marks that miss too far for sub-mm work."""
    lengths = np.linalg.norm(residuals, axis=1)
    rms = float(np.sqrt(np.mean(lengths**2)))
    if rms > _MAX_MARK_PX or rms * mm_per_px > _MAX_MARK_MM:
        worst = names[int(np.argmax(lengths))]
        rms_mm, worst_px = rms * mm_per_px, lengths.max()
        text = Doubt("marks-miss", marker=worst, worst_px=worst_px, rms_px=rms, rms_mm=rms_mm)
        return [Finding(Level.WRONG, "marks", text, name)]
    if len(lengths) and lengths.max() > 5 * max(float(np.median(lengths)), 0.2):
        worst = names[int(np.argmax(lengths))]
        text = Doubt("mark-misses", marker=worst, off_px=lengths.max())
        return [Finding(Level.WEAK, "marks", text, name)]
    return []


def accuracy_findings(position_sd_mm: Floats) -> list[Finding]:
    """Whether the expected error of the body supports sub-mm work."""
    worst = float(np.max(position_sd_mm))
    if not np.isfinite(worst):
        raise DegenerateGeometryError("the cameras do not determine the body's pose")
    if worst <= SUB_MM_SD_MM:
        return []
    return [Finding(Level.WRONG, "accuracy", Doubt("inaccurate", sd_mm=worst))]

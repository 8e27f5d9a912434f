"""A calibration's report: cameras, lenses, and what the body's position is worth with them."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from measure.arrays import Floats
from measure.calibration import RigCalibration, Verdict
from measure.calibration.findings import SUB_MM_SD_MM
from measure.checking import Level
from measure.viewing.report import figures
from measure.viewing.report.page import Page

_PLANES = ((0, 1), (0, 2))


def calibration_report(name: str, rig: RigCalibration, verdict: Verdict) -> str:
    """The report as HTML."""
    tone, sentence = _verdict(verdict)
    page = Page(f"Calibration of {name}", sentence, tone)
    page.facts(_facts(rig, verdict))
    if verdict.findings:
        columns = ("", "camera", "what, and what to do")
        rows = [(f.level.value, f.camera or "all", f.text) for f in verdict.findings]
        page.table("Findings", "", columns, rows)
    words = "The cameras as they come out."
    if rig.disagreement_mm:
        words += " Apart: how far board and markers disagree."
    figures.add_cameras(page, words, rig.cameras, rig.disagreement_mm or None)
    _add_workspace(page, rig, verdict)
    _add_marks(page, rig)
    _add_lenses(page, rig, verdict)
    return page.render("Made by measure calibrate. Everything on this page is inside this file.")


def _verdict(verdict: Verdict) -> tuple[str, str]:
    wrong = [f for f in verdict.findings if f.level is Level.WRONG]
    worst = float(verdict.position_sd_mm.max())
    known = (
        f"By this calibration alone a body's position is known to "
        f"{_rms(verdict.position_sd_mm):.3f} mm over the workspace, {worst:.3f} mm at worst "
        "(one standard deviation, 3-D)"
    )
    if wrong:
        return "bad", f"Do not trust it: {wrong[0].text}. {known}."
    weak = sum(f.level is Level.WEAK for f in verdict.findings)
    if weak or worst > SUB_MM_SD_MM:
        return "doubtful", f"{known}; {weak} weak {'point' if weak == 1 else 'points'} below."
    return "good", f"{known}."


def _facts(rig: RigCalibration, verdict: Verdict) -> list[tuple[str, str]]:
    facts = [
        ("cameras", str(len(rig.cameras))),
        ("position SD, RMS / worst",
         f"{_rms(verdict.position_sd_mm):.3f} / {verdict.position_sd_mm.max():.3f} mm"),
        ("rotation SD", f"{_rms(verdict.rotation_sd_deg):.4f} deg"),
    ]  # fmt: skip
    if np.isfinite(verdict.held_out_px):
        held_out = f"{verdict.held_out_px:.2f} px, {verdict.held_out_mm:.3f} mm"
        marked = bool(rig.observations.marks)
        what = "markers kept out of the fit, RMS" if marked else "frame sets kept out, median"
        facts.append((what, held_out))
    if np.isfinite(verdict.scale):
        facts.append(("size of the marker field by the boards", f"{verdict.scale:.5f}"))
    return facts


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _add_workspace(page: Page, rig: RigCalibration, verdict: Verdict) -> None:
    """The 27 places of the verdict, as planes through the middle."""
    grid = verdict.workspace.grid().reshape(3, 3, 3, 3)
    sd = verdict.position_sd_mm.reshape(3, 3, 3)
    maps = []
    for across, up in _PLANES:
        # The grid runs x, y, z: of the axis that is looked along, the middle.
        middle = tuple(slice(None) if axis in (across, up) else 1 for axis in range(3))
        plane, at = sd[middle], grid[middle]
        maps.append(
            figures.accuracy(
                at[:, 0, across], at[0, :, up], plane.T, (across, up), np.zeros((0, 3))
            )
        )
    centers = np.stack([camera.center for camera in rig.cameras])
    names = [camera.name for camera in rig.cameras]
    page.figures(
        "Accuracy over the workspace",
        "Standard deviation of the body's position, 3-D, from the calibration alone, on planes "
        "through the middle; and where the cameras stand.",
        *maps,
        figures.trajectory(grid.reshape(-1, 3), verdict.position_sd_mm, centers, names),
    )


def _add_marks(page: Page, rig: RigCalibration) -> None:
    maps = []
    for camera in rig.cameras:
        marks = rig.observations.marks.get(camera.name)
        if marks is None or not len(marks.ids):
            continue
        off = marks.pixels - camera.project(rig.observations.markers[marks.ids])
        if rig.fit is not None:
            off = rig.fit.mark_residuals.get(camera.name, off)
        size = camera.intrinsics.size_wh
        maps.append(figures.residual_map(marks.pixels, off, size, camera.name))
    if maps:
        page.figures(
            "Residuals of the marks in the images",
            f"Marked minus predicted, arrows {figures.ARROW_SCALE:.0f} times longer than they are.",
            *maps,
        )


def _add_lenses(page: Page, rig: RigCalibration, verdict: Verdict) -> None:
    if not rig.lenses:
        return
    page.table(
        "Lenses",
        "Held out: views kept out of the fit.",
        ("camera", "model", "views", "RMS px", "held out px", "image covered", "worst views"),
        (
            (name, lens.model.name, len(lens.views.views), float(lens.fit.rms_px),
             float(lens.held_out_px[lens.model.name]), f"{lens.views.covered_share:.0%}",
             ", ".join(f"{source} {rms:.2f} px" for source, rms in verdict.worst_views[name]))
            for name, lens in rig.lenses.items()
        ),
    )  # fmt: skip
    page.figures(
        "Where the board was seen",
        "Board corners in each part of the image; the lens is extrapolated where there are none.",
        *(
            _coverage(lens.views.coverage(), lens.views.size_wh, name)
            for name, lens in rig.lenses.items()
        ),
    )


def _coverage(counts: Floats, size_wh: tuple[int, int], name: str) -> go.Figure:
    rows, columns = counts.shape
    figure = figures.blank_image(280, name, size_wh)
    figure.add_heatmap(
        x=(np.arange(columns) + 0.5) * size_wh[0] / columns,
        y=(np.arange(rows) + 0.5) * size_wh[1] / rows,
        z=counts,
        text=counts.astype(int),
        texttemplate="%{text}",
        colorscale="Blues",
        showscale=False,
    )
    return figure

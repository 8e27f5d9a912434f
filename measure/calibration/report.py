"""A calibration's report as one self-contained HTML page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from measure.arrays import Floats
from measure.calibration.procedure import RigCalibration
from measure.calibration.verdict import Verdict

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .8em;text-align:right;"
    "border-bottom:1px solid #ccc}td:first-child,th:first-child{text-align:left}"
    ".alarm{color:#b00020;font-weight:600}.warning{color:#8a5a00}svg{margin:.5em 1em .5em 0}"
)


def calibration_report(name: str, rig: RigCalibration, verdict: Verdict) -> str:
    """The page: verdict, cameras, lenses with coverage maps, expected error over the workspace."""
    title = f"Calibration of {escape(name)}"
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title>",
        f"<style>{_STYLE}</style><h1>{title}</h1>",
        _verdict(rig, verdict),
        _cameras(rig),
        _lenses(rig, verdict),
        _workspace(verdict),
    ]
    return "\n".join(parts) + "</html>\n"


def camera_rows(rig: RigCalibration) -> list[tuple[str, float, float, float, float | None]]:
    """Per camera: name, focal length px, position sd mm, rotation sd deg, reprojection RMS px."""
    rows = []
    for camera in rig.cameras:
        P = camera.pose_covariance
        position, rotation = float("nan"), float("nan")
        if P is not None:
            position = float(np.sqrt(np.trace(P[:3, :3])))
            rotation = float(np.rad2deg(np.sqrt(np.trace(P[3:, 3:]))))
        rms = camera.reprojection_rms_px
        rows.append((camera.name, camera.intrinsics.focal_px, position, rotation, rms))
    return rows


def _verdict(rig: RigCalibration, verdict: Verdict) -> str:
    mean = float(np.sqrt(np.mean(verdict.position_sd_mm**2)))
    turn = float(np.sqrt(np.mean(verdict.rotation_sd_deg**2)))
    expected = (
        "<p>Expected error of the body from the calibration alone, one standard deviation: "
        f"<b>{mean:.3f} mm</b> (worst {verdict.position_sd_mm.max():.3f} mm), {turn:.4f} deg.</p>"
    )
    lines = [expected]
    if np.isfinite(verdict.held_out_px):
        lines.append(
            f"<p>Markers kept out of the fit are missed by {verdict.held_out_px:.2f} px "
            f"({verdict.held_out_mm:.3f} mm) RMS.</p>"
        )
    if np.isfinite(verdict.scale):
        lines.append(f"<p>Size of the marker field by the boards: {verdict.scale:.5f}.</p>")
    for camera, apart in rig.disagreement_mm.items():
        lines.append(f"<p>{escape(camera)}: board and markers disagree by {apart:.2f} mm.</p>")
    found = "".join(f'<li class="{f.level}">{escape(str(f))}</li>' for f in verdict.findings)
    return "".join(lines) + f"<ul>{found}</ul>"


def _cameras(rig: RigCalibration) -> str:
    head = ("camera", "f px", "position sd mm", "rotation sd deg", "reprojection RMS px")
    rows = [
        (name, f"{f:.2f}", f"{p:.3f}", f"{r:.4f}", "" if rms is None else f"{rms:.3f}")
        for name, f, p, r, rms in camera_rows(rig)
    ]
    return "<h2>Cameras</h2>" + _table(head, rows)


def _lenses(rig: RigCalibration, verdict: Verdict) -> str:
    out = ["<h2>Lenses</h2>"] if rig.lenses else []
    for name, lens in rig.lenses.items():
        worst = ", ".join(f"{escape(s)} {rms:.3f} px" for s, rms in verdict.worst_views[name])
        out.append(
            f"<h3>{escape(name)}</h3><p>Model {lens.model.name} ({lens.model.parameters}), "
            f"{len(lens.views.views)} views, RMS {lens.fit.rms_px:.3f} px, held out "
            f"{lens.held_out_px[lens.model.name]:.3f} px; corners seen in "
            f"{lens.views.covered_share:.0%} of the image. Worst views: {worst}.</p>"
            + coverage_svg(lens.views.coverage(), lens.views.size_wh)
        )
    return "".join(out)


def coverage_svg(counts: Floats, size_wh: tuple[int, int]) -> str:
    """Map of how many corners each part of the image saw, as an SVG element."""
    rows, columns = counts.shape
    width, height = 320.0, 320.0 * size_wh[1] / size_wh[0]
    cells = []
    for row in range(rows):
        for column in range(columns):
            shade = counts[row, column] / max(float(counts.max()), 1.0)
            cells.append(
                f'<rect x="{column * width / columns:.1f}" y="{row * height / rows:.1f}" '
                f'width="{width / columns:.1f}" height="{height / rows:.1f}" stroke="#888" '
                f'fill="rgb({255 - 175 * shade:.0f},{255 - 90 * shade:.0f},255)"/>'
                f'<text x="{(column + 0.5) * width / columns:.1f}" '
                f'y="{(row + 0.6) * height / rows:.1f}" font-size="10" text-anchor="middle">'
                f"{counts[row, column]:.0f}</text>"
            )
    body = "".join(cells)
    return f'<svg width="{width:.0f}" height="{height:.0f}" role="img">{body}</svg>'


def _workspace(verdict: Verdict) -> str:
    points = verdict.workspace.grid()
    rows = [
        (f"{x:.0f}, {y:.0f}, {z:.0f}", f"{sd:.4f}", f"{turn:.4f}")
        for (x, y, z), sd, turn in zip(
            points, verdict.position_sd_mm, verdict.rotation_sd_deg, strict=True
        )
    ]
    head = ("place mm", "position sd mm", "rotation sd deg")
    return "<h2>Expected error over the workspace</h2>" + _table(head, rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{top}</tr>{body}</table>"

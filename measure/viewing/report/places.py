"""Places in the world: cameras, the trajectory, its plans, and how well positions are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import plotly.graph_objects as go

from measure.arrays import Floats
from measure.calibration import camera_rows
from measure.model import Camera
from measure.viewing.report import figures
from measure.viewing.report.page import Page

_LINES = "#808a96"


def add_cameras(
    page: Page, words: str, cameras: Sequence[Camera], apart_mm: Mapping[str, float] | None = None
) -> None:
    """Add the table of a calibration's cameras, perhaps with how far board and markers disagree."""
    columns = (
        *("camera", "x mm", "y mm", "z mm", "position SD mm", "rotation SD deg"),
        *("focal px", "reprojection RMS px", *([] if apart_mm is None else ["apart mm"])),
    )
    rows: list[tuple[object, ...]] = []
    for camera, row in zip(cameras, camera_rows(cameras), strict=True):
        name, focal, position, turn, rms = row
        apart = () if apart_mm is None else (apart_mm.get(name, float("nan")),)
        known = (position, turn, focal, "–" if rms is None else rms)
        rows.append((name, *map(float, camera.center), *known, *apart))
    page.table("Calibration", words, columns, rows)


def trajectory(
    positions: Floats,
    sd_mm: Floats,
    camera_centers: Floats,
    camera_names: Sequence[str],
    doubtful: Floats | None = None,
) -> go.Figure:
    """Where the body went (n, 3) mm, coloured by its SD (n,), among the cameras; loose points."""
    keep = figures.thinned(len(positions), *positions.T)
    colors = {
        "color": sd_mm[keep],
        "colorscale": "Viridis",
        "size": 3,
        "colorbar": {"title": {"text": "SD [mm]", "side": "top"}, **figures.BAR_BELOW},
    }
    axis = {"showbackground": False, "gridcolor": _LINES, "zerolinecolor": _LINES, "nticks": 5}
    scene = {f"{name}axis": {**axis, "title": f"{name} [mm]"} for name in "xyz"}
    eye = {"eye": {"x": 1.3, "y": -1.6, "z": 0.9}}
    figure = figures.blank(400, scene={**scene, "aspectmode": "data", "camera": eye})
    figure.update_layout(showlegend=False, margin={"t": 0, "b": 40})
    line = {"color": figures.INK, "width": 1}
    x, y, z = positions[keep].T
    figure.add_scatter3d(x=x, y=y, z=z, mode="markers+lines", marker=colors, line=line, name="body")
    x, y, z = camera_centers.T
    marker = {"size": 5, "symbol": "diamond", "color": figures.DOUBTFUL}
    names = list(camera_names)
    figure.add_scatter3d(
        x=x, y=y, z=z, mode="markers+text", marker=marker, text=names, name="cameras"
    )
    if doubtful is not None and len(doubtful):
        x, y, z = doubtful.T
        loose = {"size": 3, "symbol": "x", "color": figures.BAD}
        figure.add_scatter3d(x=x, y=y, z=z, mode="markers", marker=loose, name="flagged")
    return figure


def plan(positions: Floats, axes: tuple[int, int], doubtful: Floats) -> go.Figure:
    """The trajectory (n, 3) mm seen along one axis, with loose points; also without 3-D."""
    figure = figures.blank(300, showlegend=False)
    figure.add_trace(_path(positions, axes, figures.ACCENT))
    if len(doubtful):
        x, y = doubtful[:, axes[0]], doubtful[:, axes[1]]
        loose = {"size": 5, "symbol": "x", "color": figures.BAD}
        figure.add_scatter(x=x, y=y, mode="markers", marker=loose, name="flagged")
    _name_axes(figure, axes, "range")
    return figure


def accuracy(
    across_mm: Floats, up_mm: Floats, sd_mm: Floats, axes: tuple[int, int], places: Floats
) -> go.Figure:
    """Expected position error (m, n) over a plane of two world axes, with what lies in it.

    NaN where nothing can be measured; `places` (k, 3) are drawn over it, where the body was, or
    markers.
    """
    figure = figures.blank(400, showlegend=False)
    bar = {"title": {"text": "SD [mm]", "side": "top"}, **figures.BAR_BELOW, "y": -0.2}
    figure.add_heatmap(
        x=across_mm, y=up_mm, z=sd_mm, colorscale="Viridis", hoverongaps=False, colorbar=bar
    )
    if len(places):
        figure.add_trace(_path(places, axes, "#ffffff"))
    _name_axes(figure, axes, "domain")
    return figure


def _path(positions: Floats, axes: tuple[int, int], color: str) -> go.Scatter:
    keep = figures.thinned(len(positions), *positions[:, axes].T)
    x, y = positions[keep][:, axes].T
    line, marker = {"color": color, "width": 1}, {"size": 4}
    return go.Scatter(x=x, y=y, mode="lines+markers", marker=marker, line=line, name="body")


def _name_axes(figure: go.Figure, axes: tuple[int, int], constrain: str) -> None:
    """Name the axes and draw both to one scale, by widening a range or narrowing the place."""
    across, up = axes
    figure.update_xaxes(title=f"{'xyz'[across]} [mm]", constrain=constrain)
    figure.update_yaxes(title=f"{'xyz'[up]} [mm]", scaleanchor="x", constrain=constrain)

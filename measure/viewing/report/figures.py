"""The figures of a report: arrays in, plotly figures out, legible in light and dark.

Plans of the world show cameras, the trajectory, and how well positions are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from measure.arrays import Floats, Ints
from measure.calibration import camera_rows
from measure.model import Camera
from measure.viewing.report.page import Page

AXIS_COLORS = {"x": "#d95f5f", "y": "#4fa35a", "z": "#4f7fd9", "3d": "#b8902e"}
INK = "#808a96"
GRID = "rgba(128,138,150,0.22)"
ACCENT = "#3d8bd4"
BAR_BELOW = {"orientation": "h", "y": -0.02, "yanchor": "top", "thickness": 10, "len": 0.8}
GOOD, DOUBTFUL, BAD = "#4fa35a", "#d99a2b", "#cf4b4b"
PALETTE = ("#3d8bd4", "#d9822b", "#4fa35a", "#b05fc4", "#c94f6d", "#2ba3a3", "#8a7a3d", "#7a86d9")


def blank(height: int = 340, x: str = "", y: str = "", **layout: Any) -> go.Figure:
    """An empty figure with these titles of its axes, legible on light and dark pages."""
    axis = {"gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GRID, "automargin": True}
    settings: dict[str, Any] = {
        "height": height,
        "margin": {"l": 10, "r": 10, "t": 28, "b": 10},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": INK, "size": 12},
        "xaxis": axis | ({"title": {"text": x}} if x else {}),
        "yaxis": axis | ({"title": {"text": y}} if y else {}),
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
    }
    settings.update(layout)
    return go.Figure(layout=settings)


def blank_image(height: int, name: str, size_wh: tuple[int, int]) -> go.Figure:
    """An empty figure of a camera's image, with its name and its pixels as axes."""
    title = {"text": name, "font": {"size": 13}, "x": 0.02, "y": 0.98, "yref": "container"}
    made = blank(height, title=title, showlegend=False)
    made.update_xaxes(range=[0, size_wh[0]], title="u [px]", constrain="domain")
    made.update_yaxes(range=[size_wh[1], 0], title="v [px]", scaleanchor="x", constrain="domain")
    return made


MAX_POINTS = 2000
"""Longer curves are thinned for drawing; extremes and gaps survive. They are drawn without WebGL,
and browsers grant a page only a few."""

ARROW_SCALE = 60.0  # How much residual arrows are magnified


def over_time(
    times_s: Floats,
    curves: Mapping[str, Floats],
    label: str,
    colors: Mapping[str, str] | None = None,
) -> go.Figure:
    """Curves (n,) by name over times (n,), in a palette unless colored; NaN leaves a gap.

    The axis ends where nearly all values do: a spike far above them would flatten all the rest.
    """
    figure = blank(x="time since the start [s]", y=label)
    if (ends := _ends_without_spikes(np.concatenate([*curves.values()]))) is not None:
        figure.update_yaxes(range=ends)
        figure.add_annotation(text=_CUT, x=1, y=1, xref="paper", yref="paper", showarrow=False)
    for index, (name, values) in enumerate(curves.items()):
        line = {"color": (colors or {}).get(name, PALETTE[index % len(PALETTE)])}
        keep = thinned(len(values), values)
        figure.add_scatter(x=times_s[keep], y=values[keep], name=name, mode="lines", line=line)
    return figure


_CUT = "spikes are cut off; a double click shows them"
_SPIKE_SPANS = 4.0  # A spike is farther off than so many times the span of 98 % of the values


def _ends_without_spikes(values: Floats) -> tuple[float, float] | None:
    """Ends of an axis for the values (n,) without spikes; None if there are no spikes."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low = np.quantile(known, 0.01, method="higher")
    high = np.quantile(known, 0.99, method="lower")
    span = float(high - low)
    if span <= 0 or (
        known.max() <= high + _SPIKE_SPANS * span and known.min() >= low - _SPIKE_SPANS * span
    ):
        return None
    near = known[(known <= high + span) & (known >= low - span)]
    margin = 0.1 * span
    return float(near.min()) - margin, float(near.max()) + margin


def histograms(
    values: Floats, names: Sequence[str], label: str, counted: str = "frame sets"
) -> go.Figure:
    """One histogram per column of values (n, k), overlaid; `counted` names the rows."""
    figure = blank(x=label, y=counted, barmode="overlay")
    known = values[np.isfinite(values)]
    # Few values in narrow bins look like a comb.
    bins = int(np.clip(2 * np.sqrt(len(known) / max(len(names), 1)), 8, 40))
    edges = np.histogram_bin_edges(known, bins)
    for index, (column, name) in enumerate(zip(values.T, names, strict=True)):
        color = AXIS_COLORS.get(name, PALETTE[index % len(PALETTE)])
        counts, _ = np.histogram(column[np.isfinite(column)], edges)
        marker = {"color": color, "line": {"width": 0}}
        middles, widths = (edges[:-1] + edges[1:]) / 2, np.diff(edges)
        figure.add_bar(x=middles, y=counts, width=widths, name=name, opacity=0.6, marker=marker)
    return figure


def residual_map(
    centers_px: Floats, residuals_px: Floats, size_wh: tuple[int, int], name: str
) -> go.Figure:
    """Residuals (n, 2) px, detected less predicted, of one camera where they occurred (n, 2)."""
    keep = thinned(len(centers_px), np.linalg.norm(residuals_px, axis=1))
    start, arrows = centers_px[keep], residuals_px[keep] * ARROW_SCALE
    lines = np.stack([start, start + arrows, np.full_like(start, np.nan)], axis=1)
    figure = blank_image(330, name, size_wh)
    x, y = lines.reshape(-1, 2).T
    line = {"color": INK, "width": 1}
    figure.add_scatter(x=x, y=y, mode="lines", line=line, hoverinfo="skip")
    size = np.linalg.norm(residuals_px[keep], axis=1)
    marker = {"color": size, "colorscale": "Turbo", "size": 5, "cmin": 0.0}
    marker["colorbar"] = {"title": {"text": "px", "side": "top"}, **BAR_BELOW, "y": -0.22}
    figure.add_scatter(x=start[:, 0], y=start[:, 1], mode="markers", marker=marker, text=size)
    return figure


def thinned(count: int, *curves: Floats) -> Ints:
    """Indices of what is drawn: all if few; else of each stretch what a longer drawing would show.

    That is both extremes of every curve (count,), and a gap (NaN) where there is one.
    """
    if count <= MAX_POINTS:
        return np.arange(count)
    ends = np.linspace(0, count, MAX_POINTS // (3 * max(len(curves), 1)) + 1).astype(np.int64)
    keep = [np.array([0, count - 1])] if curves else [ends[:-1]]
    for values in curves:
        known = np.isfinite(values)
        low, high = (np.where(known, sign * values, np.inf) for sign in (1, -1))
        keep += [_first_smallest(order, ends) for order in (low, high, known.astype(np.float64))]
    return np.unique(np.concatenate(keep))


def _first_smallest(values: Floats, ends: Ints) -> Ints:
    """Index of the first smallest value (n,) of each stretch between `ends` (m + 1,)."""
    smallest = np.minimum.reduceat(values, ends[:-1])
    at = np.flatnonzero(values == np.repeat(smallest, np.diff(ends)))
    return at[np.searchsorted(at, ends[:-1])]


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
    keep = thinned(len(positions), *positions.T)
    colors = {
        "color": sd_mm[keep],
        "colorscale": "Viridis",
        "size": 3,
        "colorbar": {"title": {"text": "SD [mm]", "side": "top"}, **BAR_BELOW},
    }
    axis = {"showbackground": False, "gridcolor": _LINES, "zerolinecolor": _LINES, "nticks": 5}
    scene = {f"{name}axis": {**axis, "title": f"{name} [mm]"} for name in "xyz"}
    eye = {"eye": {"x": 1.3, "y": -1.6, "z": 0.9}}
    figure = blank(400, scene={**scene, "aspectmode": "data", "camera": eye})
    figure.update_layout(showlegend=False, margin={"t": 0, "b": 40})
    line = {"color": INK, "width": 1}
    x, y, z = positions[keep].T
    figure.add_scatter3d(x=x, y=y, z=z, mode="markers+lines", marker=colors, line=line, name="body")
    x, y, z = camera_centers.T
    marker = {"size": 5, "symbol": "diamond", "color": DOUBTFUL}
    names = list(camera_names)
    figure.add_scatter3d(
        x=x, y=y, z=z, mode="markers+text", marker=marker, text=names, name="cameras"
    )
    if doubtful is not None and len(doubtful):
        x, y, z = doubtful.T
        loose = {"size": 3, "symbol": "x", "color": BAD}
        figure.add_scatter3d(x=x, y=y, z=z, mode="markers", marker=loose, name="flagged")
    return figure


def plan(positions: Floats, axes: tuple[int, int], doubtful: Floats) -> go.Figure:
    """The trajectory (n, 3) mm seen along one axis, with loose points; also without 3-D."""
    figure = blank(300, showlegend=False)
    figure.add_trace(_path(positions, axes, ACCENT))
    if len(doubtful):
        x, y = doubtful[:, axes[0]], doubtful[:, axes[1]]
        loose = {"size": 5, "symbol": "x", "color": BAD}
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
    figure = blank(400, showlegend=False)
    bar = {"title": {"text": "SD [mm]", "side": "top"}, **BAR_BELOW, "y": -0.2}
    figure.add_heatmap(
        x=across_mm, y=up_mm, z=sd_mm, colorscale="Viridis", hoverongaps=False, colorbar=bar
    )
    if len(places):
        figure.add_trace(_path(places, axes, "#ffffff"))
    _name_axes(figure, axes, "domain")
    return figure


def _path(positions: Floats, axes: tuple[int, int], color: str) -> go.Scatter:
    keep = thinned(len(positions), *positions[:, axes].T)
    x, y = positions[keep][:, axes].T
    line, marker = {"color": color, "width": 1}, {"size": 4}
    return go.Scatter(x=x, y=y, mode="lines+markers", marker=marker, line=line, name="body")


def _name_axes(figure: go.Figure, axes: tuple[int, int], constrain: str) -> None:
    """Name the axes and draw both to one scale, by widening a range or narrowing the place."""
    across, up = axes
    figure.update_xaxes(title=f"{'xyz'[across]} [mm]", constrain=constrain)
    figure.update_yaxes(title=f"{'xyz'[up]} [mm]", scaleanchor="x", constrain=constrain)

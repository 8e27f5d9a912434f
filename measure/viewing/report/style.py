"""Colours and layout shared by all figures, so that they read as one page in light and dark."""

from __future__ import annotations

from typing import Any

import plotly.graph_objects as go

AXIS_COLORS = {"x": "#d95f5f", "y": "#4fa35a", "z": "#4f7fd9", "3d": "#b8902e"}
INK = "#808a96"
GRID = "rgba(128,138,150,0.22)"
ACCENT = "#3d8bd4"
GOOD, DOUBTFUL, BAD = "#4fa35a", "#d99a2b", "#cf4b4b"
PALETTE = ("#3d8bd4", "#d9822b", "#4fa35a", "#b05fc4", "#c94f6d", "#2ba3a3", "#8a7a3d", "#7a86d9")


def figure(height: int = 340, **layout: Any) -> go.Figure:
    """An empty figure on a transparent ground, legible on light and dark pages."""
    axis = {"gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GRID, "automargin": True}
    settings: dict[str, Any] = {
        "height": height,
        "margin": {"l": 10, "r": 10, "t": 28, "b": 10},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": INK, "size": 12},
        "xaxis": axis,
        "yaxis": axis,
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "hovermode": "closest",
    }
    settings.update(layout)
    return go.Figure(layout=settings)


def image(height: int, name: str, size_wh: tuple[int, int]) -> go.Figure:
    """An empty figure of a camera's image, with its name and its pixels as axes."""
    title = {"text": name, "font": {"size": 13}, "x": 0.02, "y": 0.98, "yref": "container"}
    made = figure(height, title=title, showlegend=False)
    made.update_xaxes(range=[0, size_wh[0]], title="u [px]", constrain="domain")
    made.update_yaxes(range=[size_wh[1], 0], title="v [px]", scaleanchor="x", constrain="domain")
    return made

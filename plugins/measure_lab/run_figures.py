"""Figures that a run's report alone has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go

from measure.arrays import Floats, Ints
from measure.viewing.report import figures
from measure.viewing.state_colors import css


def log_log(
    across: Floats, curves: Mapping[str, Floats], label: str, other_label: str
) -> go.Figure:
    """Curves (n,) by name over positive values (n,), both axes logarithmic."""
    figure = figures.blank(x=label, y=other_label)
    for (name, values), color in zip(curves.items(), figures.PALETTE, strict=False):
        figure.add_scatter(x=across, y=values, name=name, mode="lines", line={"color": color})
    figure.update_xaxes(type="log")
    figure.update_yaxes(type="log", exponentformat="power")
    return figure


def state_timeline(
    times_s: Floats, codes: Ints, views: Sequence[str], reasons: Sequence[str]
) -> go.Figure:
    """Who saw what when, by codes (views, n) into `reasons`, 0 effective; the commonest if many."""
    count = len(times_s)
    ends = np.linspace(0, count, min(count, figures.MAX_POINTS) + 1).astype(np.int64)
    shown = codes if count <= figures.MAX_POINTS else _commonest(codes, ends)
    colors = [css(reason) for reason in reasons]
    top = max(len(reasons) - 1, 1)
    steps = [(code + end) / (top + 1) for code in range(len(reasons)) for end in (0, 1)]
    figure = figures.blank(90 + 22 * len(views), x="time since the start [s]")
    figure.add_heatmap(
        x=times_s[ends[:-1]],
        y=list(views),
        z=shown.astype(np.int8),
        zmin=-0.5,
        zmax=top + 0.5,
        colorscale=list(zip(steps, np.repeat(colors, 2), strict=True)),
        ygap=2,
        showscale=False,
    )
    for reason, color in zip(reasons, colors, strict=True):
        marker = {"symbol": "square", "size": 10, "color": color}
        figure.add_scatter(x=[None], y=[None], mode="markers", marker=marker, name=reason)
    figure.update_yaxes(autorange="reversed")
    return figure


def _commonest(codes: Ints, ends: Ints) -> Ints:
    """Of each stretch of codes (views, n) the commonest but 0; 0 where all are."""
    counts = [
        np.add.reduceat(codes == code, ends[:-1], axis=1) for code in range(1, int(codes.max()) + 1)
    ]
    if not counts:
        return np.zeros((len(codes), len(ends) - 1), dtype=np.int64)
    return np.where(np.any(counts, axis=0), 1 + np.argmax(counts, axis=0), 0)

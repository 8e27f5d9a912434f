"""The layout of a run in the Rerun viewer; it travels inside the recording."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from measure.viewing import entities


def run_blueprint(cameras: Sequence[str]) -> rrb.Blueprint:
    """3-D scene and pictures above, traces below.

    Args:
        cameras: names of the cameras.
    """
    everything = rrb.VisibleTimeRange(
        entities.TIMELINE_FRAME,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    scene = rrb.Spatial3DView(
        origin=entities.WORLD,
        name="Scene (uncertainty x100)",
        contents=["$origin/**", *(f"- {entities.image(name)}/**" for name in cameras)],
        overrides={entities.TRAIL: rrb.VisibleTimeRanges(everything)},
    )
    pictures = rrb.Grid(
        *(rrb.Spatial2DView(origin=entities.image(name), name=name) for name in cameras),
        name="Cameras",
    )
    traces = rrb.Horizontal(
        _plot("Error [mm]", "plots/error_mm"),
        _plot("Position SD [mm]", "plots/position_sd_mm"),
        _plot("Residual [px]", "plots/residual_px"),
        _plot("Ball distances [mm]", "plots/distance_mm"),
        rrb.TextLogView(origin=entities.STATUS, name="Status"),
        name="Traces",
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(scene, pictures, column_shares=[3, 4]), traces, row_shares=[5, 2]
        ),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _plot(name: str, origin: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name)

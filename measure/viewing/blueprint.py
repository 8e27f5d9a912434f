"""The layout of a run in the Rerun viewer; it travels inside the recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb

from measure.arrays import Floats
from measure.errors import DegenerateGeometryError
from measure.geometry import Rays, nearest_point
from measure.model import Camera
from measure.viewing import entities

LEGEND = rrb.PlotLegend(rrb.Corner2D.LeftTop)
_EYE_BESIDE = np.array([0.55, -1.6, 0.95])
"""Where one looks from: right, back and above, in sizes of the rig."""


def run_blueprint(
    cameras: Sequence[Camera], bodies: Sequence[str] = ("",), truth: bool = False
) -> rrb.Blueprint:
    """3-D scene and pictures above, traces below, for bodies of these names, known or not."""
    trails = [entities.TRAIL + entities.suffix(name, len(bodies) > 1) for name in bodies]
    names = [camera.name for camera in cameras]
    scene = rrb.Spatial3DView(
        origin=entities.WORLD,
        name="Scene",
        contents=["$origin/**", *(f"- {entities.image(name)}/**" for name in names)],
        overrides=dict.fromkeys(trails, up_to_cursor()),
        eye_controls=_eye(cameras),
    )
    pictures = rrb.Grid(*map(_picture, cameras), name="Cameras")
    # How frame sets ended: when and why, without the entity's path, which is always the same
    frame = rrb.encodings.TimelineColumn(entities.TIMELINE_FRAME, visible=True)
    body = rrb.encodings.TextLogColumn("body")
    columns = rrb.TextLogColumns(timeline_columns=[frame], text_log_columns=[body])
    traces = rrb.Horizontal(
        rrb.Tabs(
            *([plot("Error [mm]", "plots/error_mm")] if truth else []),
            _by_axis("Position [mm]", "plots/position_mm"),
            plot("Rotation [deg]", "plots/rotation_deg"),
        ),
        plot("Position SD [mm]", "plots/position_sd_mm"),
        plot("Residual [px]", "plots/residual_px"),
        plot("Ball distances [mm]", "plots/distance_mm"),
        rrb.TextLogView(origin=entities.STATUS, name="Status", columns=columns),
        name="Traces",
    )
    return framed(
        rrb.Vertical(
            rrb.Horizontal(scene, pictures, column_shares=[3, 4]), traces, row_shares=[5, 3]
        )
    )


def framed(content: rrb.Container) -> rrb.Blueprint:
    """A layout with the panels round it folded away."""
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def up_to_cursor() -> rrb.VisibleTimeRanges:
    """Everything from the start to the time that is looked at, on either timeline."""
    start, end = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(name, start=start, end=end)
            for name in (entities.TIMELINE_FRAME, entities.TIMELINE_TIME)
        ]
    )


def plot(name: str, origin: str) -> rrb.TimeSeriesView:
    """A plot of all traces below an entity."""
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=LEGEND)


def _by_axis(name: str, origin: str) -> rrb.Vertical:
    """Plots of x, y and z, each with a scale of its own."""
    plots = (rrb.TimeSeriesView(origin=f"{origin}/{axis}", name=axis) for axis in "xyz")
    return rrb.Vertical(*plots, name=name)


def _picture(camera: Camera) -> rrb.Spatial2DView:
    """The whole of a camera's picture, also of a run that keeps no pictures."""
    width, height = camera.intrinsics.size_wh
    bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
    return rrb.Spatial2DView(
        origin=entities.image(camera.name), name=camera.name, visual_bounds=bounds
    )


def _eye(cameras: Sequence[Camera]) -> rrb.EyeControls3D:
    """A place from which all cameras and what they look at are in view."""
    centers = np.stack([camera.center for camera in cameras])
    target = _looked_at(cameras)
    reach = float(np.linalg.norm(centers - target, axis=1).max())
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=target + 1.08 * reach * _EYE_BESIDE,
        look_target=target,
        eye_up=(0.0, 0.0, 1.0),
    )


def _looked_at(cameras: Sequence[Camera]) -> Floats:
    """Where the cameras' axes meet; half a metre ahead of them where they do not."""
    axes = np.stack([camera.world_from_camera.rotation[:, 2] for camera in cameras])
    centers = np.stack([camera.center for camera in cameras])
    try:
        target = nearest_point(Rays(centers, axes))
    except DegenerateGeometryError:
        target = centers[0] - axes[0]
    if np.median(np.einsum("nj,nj->n", target - centers, axes)) <= 0:
        return np.asarray((centers + 500.0 * axes).mean(axis=0))
    return np.asarray(target)

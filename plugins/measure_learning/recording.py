"""A robot's reported, measured and corrected positions as a Rerun recording with its own layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from measure.arrays import Floats
from measure.viewing import entities
from measure.viewing.blueprint import LEGEND, framed, plot, up_to_cursor
from measure.viewing.entities import FrameSetBatch
from measure.viewing.scene import log_lines
from measure_learning.core.correction import RobotTraces

KINDS = {"reported": (207, 75, 75), "measured": (61, 139, 212), "corrected": (79, 163, 90)}


def write_robot_recording(path: Path, name: str, frames: Floats, traces: RobotTraces) -> None:
    """Write the traces to an .rrd file; `frames` (n,) index each row's frame set."""
    stream = rr.RecordingStream("triball robot")
    stream.set_sinks(rr.FileSink(path), default_blueprint=robot_blueprint())
    stream.send_recording_name(name)
    _log_styles(stream)
    columns = FrameSetBatch(stream, frames, traces.times_s)
    for kind in KINDS:
        places: Floats = getattr(traces, f"{kind}_mm")
        seen = np.isfinite(places).all(axis=1)
        points = rr.Points3D.columns(positions=places[seen]).partition(seen.astype(int))
        columns.send(entities.robot(kind), points)
        for axis, values in zip("xyz", places.T, strict=True):
            columns.scalars(entities.robot_position(axis, kind), values)
    for kind in ("reported", "corrected"):
        away = np.linalg.norm(getattr(traces, f"{kind}_mm") - traces.measured_mm, axis=1)
        columns.scalars(entities.robot_error(kind), away)
    columns.scalars(entities.CORRECTED_SD, traces.corrected_sd_mm)
    columns.scalars(entities.UNFAMILIAR, traces.unfamiliar.astype(float))
    stream.flush()
    stream.disconnect()


def robot_blueprint() -> rrb.Blueprint:
    """The way in 3-D, the three positions per axis, and what is left of the error."""
    everything = up_to_cursor()
    scene = rrb.Spatial3DView(
        origin="robot",
        name="Reported, measured, corrected",
        overrides={entities.robot(kind): everything for kind in KINDS},
    )
    axes = rrb.Vertical(
        *(plot(f"{axis} [mm]", f"plots/robot_mm/{axis}") for axis in "xyz"), name="Position"
    )
    below = rrb.Horizontal(
        plot("Distance from the measured position [mm]", "plots/robot_error_mm"),
        rrb.TimeSeriesView(
            origin="plots/correction",
            name="SD of the correction [mm], unfamiliar states",
            plot_legend=LEGEND,
        ),
    )
    return framed(
        rrb.Vertical(rrb.Horizontal(scene, axes, column_shares=[3, 4]), below, row_shares=[5, 3])
    )


def _log_styles(stream: rr.RecordingStream) -> None:
    lines = {}
    for kind, color in KINDS.items():
        trail = rr.Points3D.from_fields(colors=[color], radii=[0.5])
        stream.log(entities.robot(kind), trail, static=True)
        for axis in "xyz":
            lines[entities.robot_position(axis, kind)] = (kind, color)
        if kind != "measured":
            lines[entities.robot_error(kind)] = (kind, color)
    lines[entities.CORRECTED_SD] = ("SD of the correction", entities.line_color(0))
    lines[entities.UNFAMILIAR] = ("unfamiliar", entities.line_color(1))
    log_lines(stream, lines)

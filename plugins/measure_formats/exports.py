"""Formats of runs, and of ROS's bags; their libraries are imported when one is written or read."""

from __future__ import annotations

from measure.session import Format
from measure_formats import ros, tables
from measure_formats.bag_pictures import open_bag_stream
from measure_formats.poses import bag_poses, table_poses

CSV = Format(
    "csv",
    "poses with covariances, for tables",
    read_truth=table_poses,
    write_run=tables.write_csv,
    holds_velocity=True,
)
TUM = Format("tum", "poses in metres, for evo", write_run=tables.write_tum)
TRC = Format("trc", "balls, for OpenSim", write_run=tables.write_trc, holds_poses=False)
C3D = Format(
    "c3d",
    "balls, for motion laboratories",
    write_run=tables.write_c3d,
    holds_poses=False,
    extra="c3d",
)
MCAP = Format(
    "mcap",
    "poses in metres, for ROS 2",
    read_truth=bag_poses,
    open_pictures=open_bag_stream,
    write_run=ros.write,
    holds_velocity=True,
    extra="ros",
)

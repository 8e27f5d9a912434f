"""A run read back, finished or not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from measure.arrays import Bools, Floats
from measure.errors import RunError
from measure.geometry import RigidTransform
from measure.model import Body, Camera
from measure.results.columns import matrices, numbers
from measure.results.distances import BallDistance, ball_distances, body_notes, contradictions
from measure.results.provenance import read_provenance
from measure.results.stored import read_tables
from measure.results.summary import Summary, summarise
from measure.results.tables import PLACE
from measure.session import read_body, read_calibration


@dataclass(frozen=True, eq=False)
class Run:
    """A run.

    Attributes:
        path: its folder.
        provenance: the values of `run.toml`.
        body: as measured.
        cameras: as used.
        detections: one row per frame set, camera and ball (see `measure.results.tables`).
        balls: one row per position.
        poses: one row per frame set, also where there is no pose.
        finished: whether it came to its end.
    """

    path: Path
    provenance: dict[str, Any]
    body: Body
    cameras: tuple[Camera, ...]
    detections: pa.Table
    balls: pa.Table
    poses: pa.Table
    finished: bool

    @cached_property
    def summary(self) -> Summary:
        """The run in a few numbers."""
        notes = self.provenance.get("session", {}).get("notes", ())
        known = (self.body, self.cameras, self.distances, self.detections, self.poses)
        return summarise(self.detections, self.poses, notes, body_notes(*known))

    @cached_property
    def distances(self) -> list[BallDistance]:
        """Of every pair of balls, over the run."""
        return ball_distances(self.body, self.balls, self.poses)

    @property
    def session(self) -> Path | None:
        """The session measured: its file, or the folder of `session.toml`; None if it is gone."""
        path = self.provenance.get("session", {}).get("path")
        return Path(path) if path and Path(path).exists() else None

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What they say against the body file, a line each."""
        return contradictions(self.body, self.distances)

    @property
    def times_s(self) -> Floats:
        """Instants (n,) of the frame sets."""
        return numbers(self.poses, "time_s")

    @cached_property
    def has_pose(self) -> Bools:
        """Which frame sets (n,) have a pose."""
        return np.isfinite(numbers(self.poses, "x_mm"))

    @cached_property
    def world_from_body(self) -> RigidTransform:
        """The poses of the frame sets that have one, in order."""
        place = numbers(self.poses, *PLACE)[self.has_pose]
        return RigidTransform.from_quat_wxyz(place[:, 3:], place[:, :3])

    @cached_property
    def covariances(self) -> Floats:
        """Covariances (m, 6, 6) of the poses there are."""
        return matrices(self.poses, "covariance", 6)[self.has_pose]


def read_run(folder: Path) -> Run:
    """Read a run folder; of an unfinished run, what was measured so far.

    Raises:
        RunError: the folder is no run, or a file of it is damaged.
    """
    file = folder / "run.toml"
    if not file.exists():
        what = "no such folder" if not folder.exists() else "it has no run.toml"
        raise RunError(f"{folder} is no run: {what}; `measure run` makes one")
    provenance = read_provenance(file)
    body = read_body(folder / "body.toml")
    cameras = read_calibration(folder / "calibration.toml").cameras
    tables = read_tables(folder, body, cameras)
    finished = not (folder / "poses.arrows").exists()
    return Run(folder, provenance, body, cameras, **tables, finished=finished)

"""A run read back, finished or not."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from measure.arrays import Bools, Floats
from measure.checking.finding import Finding, Level, worst_first
from measure.errors import RunError
from measure.geometry import RigidTransform, propagate
from measure.measuring.kept_rig import CameraChange
from measure.model import Body, Camera
from measure.results.distances import BallDistance, ball_distances, contradictions, rig_findings
from measure.results.journal import is_missing, read_table
from measure.results.provenance import Provenance, read_provenance
from measure.results.rig_changes import (
    CameraMove,
    camera_moves,
    changes_of,
    moved_findings,
    of_unmoved,
)
from measure.results.stored import read_tables, rows_of_body
from measure.results.summary import Summary, summarise
from measure.results.tables import PLACE, RELATIVE_SCHEMA, SCHEMAS, matrices, numbers, texts
from measure.session import read_bodies, read_body, read_calibration

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Run:
    """A run."""

    path: Path  # its folder
    provenance: dict[str, Any]  # the values of `run.toml`
    body: Body  # as measured
    cameras: tuple[Camera, ...]  # as used
    detections: pa.Table  # one row per frame set, camera and ball (see `measure.results.tables`)
    balls: pa.Table  # one row per position
    poses: pa.Table  # one row per frame set, also where there is no pose
    finished: bool  # whether it came to its end
    several: bool = False  # whether other bodies were measured with it

    def relative(self) -> pa.Table:
        """The poses of bodies relative to the reference; RunError: the run has none."""
        if is_missing(self.path, "relative"):
            raise RunError(
                f"{self.path} holds no relative poses: measure the recording with --reference NAME"
            )
        return read_table(self.path, "relative", RELATIVE_SCHEMA)

    @cached_property
    def summary(self) -> Summary:
        """The run in a few numbers."""
        notes = Provenance.of(self.provenance).notes
        known = {note.subject for note in notes if note.level is Level.WRONG}
        seen = of_unmoved(self.detections, self.camera_changes)
        about = rig_findings(self.body, self.cameras, self.distances, seen, self.poses, known)
        follows = self.provenance.get("calibration", {}).get("keep") != "warn"
        if moves := self.camera_moves:
            moved = moved_findings(moves, float(self.times_s[0]), follows)
            about = worst_first((*moved, *about))
        return summarise(self.detections, self.poses, notes, about, self.scale_sd)

    @cached_property
    def camera_changes(self) -> tuple[CameraChange, ...]:
        """Cameras that were left out, and used again where they stood then; in order."""
        return changes_of(self.provenance)

    @property
    def camera_moves(self) -> list[CameraMove]:
        """The times that a camera was moved."""
        return camera_moves(self.camera_changes, self.cameras, self.times_s)

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
    def scale_sd(self) -> float:
        """Standard deviation of the world's scale, which no pose's covariance holds."""
        return float(self.provenance.get("calibration", {}).get("scale_sd", 0.0))

    @property
    def contradictions(self) -> tuple[Finding, ...]:
        """What they say against the body file."""
        return contradictions(self.body, self.distances)

    @property
    def times_s(self) -> Floats:
        """Instants (n,) of the frame sets."""
        return numbers(self.poses, "time_s")

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Instants of the first and the last frame set, if there is one."""
        times_s = self.times_s
        return (float(times_s[0]), float(times_s[-1])) if len(times_s) else None

    @cached_property
    def has_pose(self) -> Bools:
        """Which frame sets (n,) have a pose."""
        return np.isfinite(numbers(self.poses, "x_mm"))

    @cached_property
    def unflagged(self) -> Bools:
        """Which frame sets (n,) have a pose to rely on."""
        return np.asarray(self.has_pose & (texts(self.poses, "status") == "ok"))

    @cached_property
    def world_from_body(self) -> RigidTransform:
        """The poses of the frame sets that have one, in order."""
        place = numbers(self.poses, *PLACE)[self.has_pose]
        return RigidTransform.from_quat_wxyz(place[:, 3:], place[:, :3])

    @cached_property
    def covariances(self) -> Floats:
        """Covariances (m, 6, 6) of the poses there are."""
        return matrices(self.poses, "covariance", 6)[self.has_pose]

    def in_frame(self, frame_from_world: RigidTransform) -> Run:
        """The same poses and cameras in the axes of another frame, which is known exactly."""
        poses, n = self.poses, self.poses.num_rows
        moved = frame_from_world @ self.world_from_body
        place = np.full((n, 7), np.nan)
        place[self.has_pose] = np.hstack([moved.translation, moved.quat_wxyz])
        covariance = np.zeros((n, 36))
        turned = propagate(_chart_turn(frame_from_world), self.covariances)
        covariance[self.has_pose] = turned.reshape(-1, 36)
        new = dict(zip(PLACE, (pa.array(x, mask=~self.has_pose) for x in place.T), strict=True))
        new["covariance"] = pa.array([*covariance], pa.list_(pa.float64(), 36), mask=~self.has_pose)
        for name, column in new.items():
            poses = poses.set_column(poses.column_names.index(name), name, column)
        cameras = tuple(camera_in(frame_from_world, camera) for camera in self.cameras)
        return replace(self, cameras=cameras, poses=poses)


def camera_in(frame_from_world: RigidTransform, camera: Camera) -> Camera:
    """A camera and its uncertainty in another frame than its world."""
    turn = _chart_turn(frame_from_world)
    own, both = camera.pose_covariance, camera.pose_intrinsics_covariance
    return replace(
        camera,
        world_from_camera=frame_from_world @ camera.world_from_camera,
        pose_covariance=None if own is None else propagate(turn, own),
        pose_intrinsics_covariance=None if both is None else turn @ both,
    )


def _chart_turn(frame_from_world: RigidTransform) -> Floats:
    """Matrix (6, 6) that takes a pose's `perturb` chart to that of the pose in another frame."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = frame_from_world.rotation
    return out


def read_run(folder: Path, body: str | None = None) -> Run:
    """Read a run folder, of several bodies the named one; of an unfinished run, what was measured.

    RunError: the folder is no run, a file of it is damaged, or it is not said which body.
    """
    return one_of(read_runs(folder), folder, body)


def one_of(runs: Sequence[Run], folder: Path, body: str | None) -> Run:
    """The run of a body, by its name where there are several; RunError as `read_run`."""
    named = [run for run in runs if body in (None, run.body.name)]
    if len(named) == 1:
        return named[0]
    known = ", ".join(run.body.name for run in runs)
    if body is None:
        raise RunError(f"{folder} measured several bodies, {known}: choose one with --body NAME")
    raise RunError(f"{folder} measured no body '{body}': there is {known}")


def read_runs(folder: Path) -> list[Run]:
    """A run for each body that a folder's run measured; RunError: no run, or a damaged file.

    Of one that is not finished a warning says how far it came.
    """
    file = folder / "run.toml"
    if not file.exists():
        what = "no such folder" if not folder.exists() else "it has no run.toml"
        raise RunError(f"{folder} is no run: {what}; `measure run` makes one")
    provenance = read_provenance(file)
    several = (folder / "bodies.toml").exists()
    bodies = read_bodies(folder / "bodies.toml") if several else (read_body(folder / "body.toml"),)
    cameras = read_calibration(folder / "calibration.toml").cameras
    tables = read_tables(folder, bodies, cameras)
    finished = not (folder / "poses.arrows").exists()
    count = tables["poses"].num_rows // len(bodies)
    if not finished and count:
        _log.warning(
            "%s is not finished: this is of the %d frame sets it has so far", folder, count
        )
    return runs_of(provenance, bodies, folder, cameras, tables, finished)


def runs_of(
    provenance: dict[str, Any],
    bodies: Sequence[Body],
    folder: Path,
    cameras: tuple[Camera, ...],
    tables: Mapping[str, pa.Table],
    finished: bool,
) -> list[Run]:
    """A run for each body, from the tables of all."""
    return [
        Run(
            folder,
            provenance,
            body,
            cameras,
            **{name: rows_of_body(tables[name], body.name) for name in SCHEMAS},
            finished=finished,
            several=len(bodies) > 1,
        )
        for body in bodies
    ]

"""Cameras that were moved during a run: as `run.toml` lists them, and as findings say it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import BaseModel, Field, FiniteFloat

from measure.arrays import Floats
from measure.checking.causes import Word
from measure.checking.finding import Finding, Level
from measure.geometry import RigidTransform
from measure.limits import TINY
from measure.measuring.kept_rig import CameraChange
from measure.model import Camera

CHANGES = "camera_changes"
_Row = list[FiniteFloat]


class ChangeTable(BaseModel):
    """One `[[camera_changes]]` table of `run.toml`."""

    camera: str
    frame_set: int = Field(ge=0)
    since_s: FiniteFloat
    quat_wxyz: _Row | None = Field(None, min_length=4, max_length=4)  # None: it is left out
    translation_mm: _Row = Field([0.0, 0.0, 0.0], min_length=3, max_length=3)
    pose_covariance: list[_Row] | None = None


def change_values(changes: Sequence[CameraChange]) -> dict[str, Any]:
    """As written to `run.toml`; nothing without a change."""
    tables = []
    for change in changes:
        pose, known = change.world_from_camera, change.covariance
        table: dict[str, Any] = {
            "camera": change.camera,
            "frame_set": change.frame_set,
            "since_s": change.since_s,
        }
        if pose is not None:
            table["quat_wxyz"] = pose.quat_wxyz.tolist()
            table["translation_mm"] = pose.translation.tolist()
        if known is not None:
            table["pose_covariance"] = known.tolist()
        tables.append(table)
    return {CHANGES: tables} if tables else {}


def changes_of(values: Mapping[str, Any]) -> tuple[CameraChange, ...]:
    """The changes by the values of a `run.toml`."""
    out = []
    for one in (ChangeTable.model_validate(table) for table in values.get(CHANGES, ())):
        pose, known = None, one.pose_covariance
        if one.quat_wxyz is not None:
            pose = RigidTransform.from_quat_wxyz(one.quat_wxyz, one.translation_mm)
        covariance = None if known is None else np.array(known, dtype=np.float64)
        out.append(CameraChange(one.camera, one.frame_set, one.since_s, pose, covariance))
    return tuple(out)


def of_unmoved(detections: pa.Table, changes: Sequence[CameraChange]) -> pa.Table:
    """The detections of cameras that stood where the calibration says throughout."""
    moved = pa.array({change.camera for change in changes}, pa.string())
    return detections.filter(pc.invert(pc.is_in(detections["camera"], value_set=moved)))


class CameraMove(NamedTuple):
    """A camera that was moved, or drifted."""

    camera: str
    since_s: float  # when
    until_s: float | None = None  # from when on it was used where it stood then; None: not at all
    shift_mm: float | None = None  # how far it was moved, and turned; None: not known
    turn_deg: float | None = None
    turn_sd_deg: float | None = None
    drifted: bool = False  # followed in steps, and never left out


def camera_moves(
    changes: Sequence[CameraChange], cameras: Sequence[Camera], times_s: Floats
) -> list[CameraMove]:
    """Each time that a camera was moved, from the changes, the cameras as calibrated, and times."""
    stands = {camera.name: camera.world_from_camera for camera in cameras}
    out, begun = list[CameraMove](), dict[str, tuple[int, RigidTransform]]()
    for change in changes:
        name, pose = change.camera, change.world_from_camera
        last = out[begun[name][0]] if name in begun else None
        if pose is None or last is None or (last.until_s is not None and not last.drifted):
            begun[name] = len(out), stands[name]
            out.append(CameraMove(name, change.since_s, drifted=pose is not None))
        if pose is not None:
            place, before = begun[name]
            (shift_mm, _), (turn_deg, sd_deg) = moved_by(pose, before, change.covariance)
            known = None if change.covariance is None else sd_deg
            until_s = float(times_s[min(change.frame_set, len(times_s) - 1)])
            out[place] = out[place]._replace(
                until_s=until_s, shift_mm=shift_mm, turn_deg=turn_deg, turn_sd_deg=known
            )
            stands[name] = pose
    return out


def moved_by(
    now: RigidTransform, before: RigidTransform, known: Floats | None
) -> list[list[float]]:
    """By how many mm a camera was shifted, and turned by how many deg; each with its SD."""
    out = []
    for part, unit in ((slice(0, 3), 1.0), (slice(3, 6), float(np.degrees(1)))):
        step = now.difference(before)[part]
        size = float(np.linalg.norm(step))
        axis = step / max(size, TINY)
        sd = 0.0 if known is None else float(np.sqrt(axis @ known[part, part] @ axis))
        out.append([unit * size, unit * sd])
    return out


def moved_findings(moves: Sequence[CameraMove], start_s: float, follows: bool) -> list[Finding]:
    """One of each time that a camera was moved, or drifted: from when to when, and how far.

    Args:
        start_s: time of the first frame set.
        follows: whether cameras were left out and brought back at all.
    """
    out = []
    for one in moves:
        text = f"{one.camera} was moved {one.since_s - start_s:.1f} s after the start"
        level, remedy, far = Level.WEAK, "calibrate it again", ""
        if one.until_s is not None:
            far = f"{one.shift_mm:.1f} mm and {one.turn_deg:.2f} deg from where it was"
        if one.drifted:
            text = (
                f"{one.camera} drifts, and is followed from {one.since_s - start_s:.1f} s on: {far}"
            )
            level, remedy = Level.NOTE, "let it run warm, fasten its stand, and calibrate it again"
        elif not follows:
            level = Level.WRONG
            remedy = "measure with `--keep-calibration follow`, or calibrate it again"
        elif one.until_s is None:
            text += ", and is left out from there on"
        else:
            text += (
                f", left out until {one.until_s - start_s:.1f} s, and used from there where it "
                f"stands now ({far})"
            )
            level, remedy = Level.NOTE, "calibrate it again before the next recording"
        out.append(
            Finding(
                level,
                "calibration",
                f"{text}: {remedy}",
                code=str(Word.DRIFT if one.drifted else Word.MOVED_AT),
                subject=one.camera,
                estimate=one.turn_deg,
                sd=one.turn_sd_deg,
                unit="" if one.turn_deg is None else "deg",
                since_s=one.since_s,
                remedy=remedy,
            )
        )
    return out

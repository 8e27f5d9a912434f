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
    """A camera that was moved."""

    camera: str
    since_s: float  # when
    until_s: float | None  # from when on it was used again; None: not at all
    shift_mm: float | None  # how far it was moved, and turned; None: not known
    turn_deg: float | None
    turn_sd_deg: float | None


def camera_moves(
    changes: Sequence[CameraChange], cameras: Sequence[Camera], times_s: Floats
) -> list[CameraMove]:
    """Each time that a camera was moved, from the changes, the cameras as calibrated, and times."""
    stands = {camera.name: camera.world_from_camera for camera in cameras}
    out = []
    for place, change in enumerate(changes):
        name, since_s = change.camera, change.since_s
        if change.world_from_camera is not None:
            continue
        back = next((c for c in changes[place + 1 :] if c.camera == name), None)
        if back is None or back.world_from_camera is None:
            out.append(CameraMove(name, since_s, None, None, None, None))
            continue
        step = back.world_from_camera.difference(stands[name])
        stands[name], turn, sd_deg = back.world_from_camera, float(np.linalg.norm(step[3:])), None
        if back.covariance is not None:
            axis = step[3:] / max(turn, TINY)
            sd_deg = float(np.degrees(np.sqrt(axis @ back.covariance[3:, 3:] @ axis)))
        until_s = float(times_s[min(back.frame_set, len(times_s) - 1)])
        shift_mm = float(np.linalg.norm(step[:3]))
        out.append(CameraMove(name, since_s, until_s, shift_mm, float(np.degrees(turn)), sd_deg))
    return out


def moved_findings(moves: Sequence[CameraMove], start_s: float, follows: bool) -> list[Finding]:
    """One of each time that a camera was moved: from when to when it was left out, and how far.

    Args:
        start_s: time of the first frame set.
        follows: whether cameras were left out and brought back at all.
    """
    out = []
    for one in moves:
        text = f"{one.camera} was moved {one.since_s - start_s:.1f} s after the start"
        level, remedy = Level.WEAK, "calibrate it again"
        if not follows:
            level = Level.WRONG
            remedy = "measure with `--keep-calibration follow`, or calibrate it again"
        elif one.until_s is None:
            text += ", and is left out from there on"
        else:
            text += (
                f", left out until {one.until_s - start_s:.1f} s, and used from there where it "
                f"stands now ({one.shift_mm:.1f} mm and {one.turn_deg:.2f} deg from where it was)"
            )
            level, remedy = Level.NOTE, "calibrate it again before the next recording"
        out.append(
            Finding(
                level,
                "calibration",
                f"{text}: {remedy}",
                code=str(Word.MOVED_AT),
                subject=one.camera,
                estimate=one.turn_deg,
                sd=one.turn_sd_deg,
                unit="" if one.turn_deg is None else "deg",
                since_s=one.since_s,
                remedy=remedy,
            )
        )
    return out

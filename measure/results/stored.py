"""The tables of a run folder, as far as they belong together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.errors import RunError
from measure.model import Body, Camera
from measure.results.files import MEND
from measure.results.journal import is_missing, read_table
from measure.results.tables import SCHEMAS

PLACE = ("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")
"""The columns of a pose."""
_UNIT = 1e-3
"""By how much a quaternion's length may differ from one."""


def read_tables(
    folder: Path, body: Body, cameras: Sequence[Camera], begun_only: bool = False
) -> dict[str, pa.Table]:
    """The rows of all frame sets whose pose was written; a kill may leave some of one more.

    Args:
        folder: of the run.
        body: that was measured.
        cameras: that saw it.
        begun_only: whether tables may be missing: those of a run that was only begun.

    Raises:
        RunError: a table is missing or cannot be read, or holds what no run of these writes.
    """
    tables = {
        name: schema.empty_table()
        if begun_only and is_missing(folder, name)
        else read_table(folder, name, schema)
        for name, schema in SCHEMAS.items()
    }
    complete = tables["poses"].num_rows
    tables = {name: t.filter(pc.less(t["index"], complete)) for name, t in tables.items()}
    known = {
        "ball": ("body.toml", body.names),
        "camera": ("calibration.toml", [camera.name for camera in cameras]),
    }
    for what, wrong in (
        ("poses", _wrong_poses(tables["poses"])),
        ("balls", _wrong_rows(tables["balls"], known) or _wrong_balls(tables["balls"])),
        ("detections", _wrong_rows(tables["detections"], known)),
    ):
        if wrong:
            raise RunError(f"{folder}: the {what} are damaged: {wrong}: {MEND}")
    return tables


def _wrong_rows(table: pa.Table, known: Mapping[str, tuple[str, Sequence[str]]]) -> str:
    """Rows of no frame set, or of a ball or camera that the run has not."""
    if len(table) and pc.min(table["index"]).as_py() < 0:
        return "frame sets count from 0"
    for column in known.keys() & set(table.column_names):
        file, names = known[column]
        for name in pc.unique(table[column]).to_pylist():
            if name not in names:
                return f"{column} {name!r} is not in {file} ({', '.join(names)})"
    return ""


def _wrong_balls(balls: pa.Table) -> str:
    place = np.stack([balls[name].to_numpy() for name in ("time_s", *PLACE[:3])], axis=1)
    if not np.isfinite(place).all():
        return "a ball has no time or place"
    return "" if _all_numbers(balls["covariance_mm2"]) else "a ball has no covariance"


def _all_numbers(column: pa.ChunkedArray) -> bool:
    """Whether lists of numbers are complete and finite."""
    return not column.null_count and bool(np.isfinite(pc.list_flatten(column).to_numpy()).all())


def _wrong_poses(poses: pa.Table) -> str:
    if not np.array_equal(poses["index"].to_numpy(), np.arange(len(poses))):
        return "frame sets are missing or out of order"
    place = np.stack([poses[name].to_numpy() for name in ("time_s", *PLACE)], axis=1)
    there = np.isfinite(place[:, 1])
    bad = ~np.isfinite(place[:, 0]) | (there & ~np.isfinite(place).all(axis=1))
    length = np.linalg.norm(np.where(bad[:, None], 1.0, place)[there, 4:], axis=1)
    bad[there] |= np.abs(length - 1) > _UNIT
    if bad.any():
        return f"frame set {int(np.argmax(bad))} has no time, or half a pose"
    covariances = poses["covariance"].filter(pa.array(there))
    return "" if _all_numbers(covariances) else "a pose has no covariance"

"""The tables of a run folder, as far as they belong together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.errors import RunError
from measure.measuring import Status
from measure.model import Body, Camera
from measure.model.observations import Reason, State
from measure.results.columns import numbers
from measure.results.files import MEND
from measure.results.journal import is_missing, read_table
from measure.results.tables import PLACE, SCHEMAS

_Known = tuple[str, Sequence[str]]
"""Words, and what they are: `in body.toml`."""
_ANY: _Known = ("a text", ())
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
    # Poses first: of a run that is being written, what they were made from is there already.
    tables = {
        name: schema.empty_table()
        if begun_only and is_missing(folder, name)
        else read_table(folder, name, schema)
        for name, schema in reversed(SCHEMAS.items())
    }
    words = _words(body, cameras)
    for what, table in tables.items():
        wrong = _wrong_poses(table) if what == "poses" else ""
        wrong = _wrong_balls(table) if what == "balls" else wrong
        if wrong := wrong or _wrong_order(table) or _wrong_words(table, words[what]):
            raise RunError(f"{folder}: the {what} are damaged: {wrong}: {MEND}")
    complete = tables["poses"].num_rows
    return {name: t.filter(pc.less(t["index"], complete)) for name, t in tables.items()}


def _wrong_order(table: pa.Table) -> str:
    """Rows of no frame set, or not one after the other."""
    index = table["index"]
    if index.null_count or (len(index) and pc.min(index).as_py() < 0):
        return "frame sets count from 0"
    return "frame sets are out of order" if np.any(np.diff(index.to_numpy()) < 0) else ""


def _words(body: Body, cameras: Sequence[Camera]) -> dict[str, dict[str, _Known]]:
    """By table and column, the words that may stand there."""
    ball = ("in body.toml", body.names)
    camera = ("in calibration.toml", [camera.name for camera in cameras])
    status, state, reason = (("known", list(kind)) for kind in (Status, State, Reason))
    return {
        "poses": {"cameras": camera, "balls": ball, "status": status, "flags": _ANY},
        "balls": {"ball": ball, "cameras": camera, "dropped": camera},
        "detections": {"ball": ball, "camera": camera, "state": state, "reason": reason},
    }


def _wrong_words(table: pa.Table, words: Mapping[str, _Known]) -> str:
    """Cells with a word that is none of those that may stand there."""
    for column, (where, known) in words.items():
        cells = table[column]
        listed = pc.list_flatten(cells) if pa.types.is_list(cells.type) else cells
        for word in pc.unique(listed).to_pylist():
            if word is None or (known and word not in known):
                among = f" ({', '.join(filter(None, known))})" if known else ""
                return f"{column} {word!r} is not {where}{among}"
    return ""


def _wrong_balls(balls: pa.Table) -> str:
    place = numbers(balls, "time_s", *PLACE[:3])
    if not np.isfinite(place).all():
        return "a ball has no time or place"
    return "" if _all_numbers(balls["covariance_mm2"]) else "a ball has no covariance"


def _all_numbers(column: pa.ChunkedArray) -> bool:
    """Whether lists of numbers are complete and finite."""
    return not column.null_count and bool(np.isfinite(pc.list_flatten(column).to_numpy()).all())


def _wrong_poses(poses: pa.Table) -> str:
    if not np.array_equal(poses["index"].to_numpy(), np.arange(len(poses))):
        return "frame sets are missing or out of order"
    place = numbers(poses, "time_s", *PLACE)
    there = np.isfinite(place[:, 1])
    bad = ~np.isfinite(place[:, 0]) | (there & ~np.isfinite(place).all(axis=1))
    length = np.linalg.norm(np.where(bad[:, None], 1.0, place)[there, 4:], axis=1)
    bad[there] |= np.abs(length - 1) > _UNIT
    if bad.any():
        return f"frame set {int(np.argmax(bad))} has no time, or half a pose"
    covariances = poses["covariance"].filter(pa.array(there))
    return "" if _all_numbers(covariances) else "a pose has no covariance"

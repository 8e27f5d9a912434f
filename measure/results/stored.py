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
from measure.results.journal import MEND, is_missing, read_begun_table
from measure.results.provenance import Provenance, read_provenance
from measure.results.tables import BODY, PLACE, numbers, schemas
from measure.session.calibration_file import UNIT_TOLERANCE

_Known = tuple[str, Sequence[str]]  # Words, and what they are: `in body.toml`
_TEXTS: dict[str, _Known] = {"flags": ("a text", ()), "doubts": ("a text", ())}


def read_tables(
    folder: Path,
    bodies: Sequence[Body],
    cameras: Sequence[Camera],
    begun_only: bool = False,
    relative: bool = False,
) -> dict[str, pa.Table]:
    """The rows of all complete frame sets; a kill may leave some of one more.

    A power cut may take the last rows of each table. Tables of a run that was only begun may be
    missing. RunError: one is missing or cannot be read, or holds what no run of these bodies and
    cameras writes.
    """
    # Poses first: of a run that is being written, what they were made from is there already.
    found = {
        name: (schema.empty_table(), None)
        if begun_only and is_missing(folder, name)
        else read_begun_table(folder, name, schema)
        for name, schema in reversed(schemas(len(bodies) > 1, relative).items())
    }
    tables = {name: table for name, (table, _) in found.items()}
    for what, table in tables.items():
        each = (_wrong_rows(what, rows_of_body(table, b.name), b, cameras) for b in bodies)
        if wrong := _wrong_bodies(table, bodies) or next(filter(None, each), ""):
            raise RunError(f"{folder}: the {what} are damaged: {wrong}: {MEND}")
    known = [frame_sets for _, frame_sets in found.values() if frame_sets is not None]
    complete = min([tables["poses"].num_rows // len(bodies), *known])
    return {name: t.filter(pc.less(t["index"], complete)) for name, t in tables.items()}


def rows_of_body(table: pa.Table, name: str) -> pa.Table:
    """The rows of one body, as the table of a run of that body alone."""
    if BODY not in table.column_names:
        return table
    return table.filter(pc.equal(table[BODY], name)).drop_columns([BODY])


def _wrong_bodies(table: pa.Table, bodies: Sequence[Body]) -> str:
    if len(bodies) == 1:
        return ""
    known = [body.name for body in bodies]
    strange = [name for name in pc.unique(table[BODY]).to_pylist() if name not in known]
    return f"body {strange[0]!r} is not in bodies.toml ({', '.join(known)})" if strange else ""


def _wrong_rows(what: str, rows: pa.Table, body: Body, cameras: Sequence[Camera]) -> str:
    if what == "relative":
        return ""
    wrong = _wrong_poses(rows) if what == "poses" else ""
    wrong = _wrong_balls(rows) if what == "balls" else wrong
    return wrong or _wrong_order(rows) or _wrong_words(rows, _words(body, cameras)[what])


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
        "poses": {"cameras": camera, "balls": ball, "status": status, **_TEXTS},
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
    bad[there] |= np.abs(length - 1) > UNIT_TOLERANCE
    if bad.any():
        return f"frame set {int(np.argmax(bad))} has no time, or half a pose"
    covariances = poses["covariance"].filter(pa.array(there))
    return "" if _all_numbers(covariances) else "a pose has no covariance"


def refuse_other_run(folder: Path, provenance: Provenance) -> None:
    """Refuse (RunError) to go on with a run that was made from something else."""
    if changed := provenance.differences(read_provenance(folder / "run.toml")):
        raise RunError(
            f"{folder} cannot be resumed: its run was made with other {', '.join(changed)}; "
            "--overwrite starts anew"
        )

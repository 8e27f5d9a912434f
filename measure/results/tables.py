"""The three tables of a run: their columns, how a measurement becomes rows, and rows arrays."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import StringIO
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from measure.arrays import Floats, Ints
from measure.host.interfaces import PLACE as PLACE
from measure.host.interfaces import QUALITY as QUALITY
from measure.host.interfaces import pose_columns
from measure.limits import AT_ONCE
from measure.measuring import Measurement, relative_measurements
from measure.model import BallView, Body, Camera, Doubt

_F, _I, _S = pa.float64(), pa.int32(), pa.string()
_FRAME = pa.int64()  # Pictures may be numbered by the microseconds since 1970
_WORDS = pa.list_(pa.string())

SCHEMAS = {
    "detections": pa.schema(
        [
            ("index", _I),
            ("camera", _S),
            ("ball", _S),
            ("frame", _FRAME),
            ("time_s", _F),
            ("state", _S),
            ("reason", _S),
            *((name, _F) for name in ("u_px", "v_px", "radius_px")),
            *((name, _F) for name in ("var_uu_px2", "var_uv_px2", "var_vv_px2")),
            *((name, _F) for name in ("score", "color_match", "residual_u_px", "residual_v_px")),
        ]
    ),
    "balls": pa.schema(
        [
            ("index", _I),
            ("ball", _S),
            ("time_s", _F),
            *((name, _F) for name in PLACE[:3]),
            ("covariance_mm2", pa.list_(_F, 9)),
            ("rms_mm", _F),
            ("cameras", _WORDS),
            ("dropped", _WORDS),
        ]
    ),
    "poses": pa.schema(
        [
            ("index", _I),
            ("time_s", _F),
            *((name, _F) for name in PLACE),
            ("covariance", pa.list_(_F, 36)),
            *((name, _F) for name in QUALITY),
            ("cameras", _WORDS),
            ("balls", _WORDS),
            ("flags", _WORDS),
            ("status", _S),
            ("reason", _S),
            ("doubts", _WORDS),
        ]
    ),
}
"""By table. `covariance` is the 6x6 of docs/conventions.md, row by row: mm^2, mm rad, rad^2."""

BODY = "body"  # The additional column of a run of several bodies, in every table

CSV_COLUMNS = (
    *("frame", "time_s", *PLACE, "position_sd_mm", "rotation_sd_deg", "rms_px"),
    *("cameras", "status", "reason", "codes"),
)
RELATIVE_COLUMNS = (CSV_COLUMNS[0], BODY, "reference", *CSV_COLUMNS[1:])
"""Of `relative.csv`: the pose is reference_from_body."""
RELATIVE_SCHEMA = pa.schema([(BODY, _S), ("reference", _S), *SCHEMAS["poses"]])
_UNKNOWN = np.full(2, np.nan)
_NINE_DECIMALS = {"time_s", *PLACE[3:]}


def schemas(several: bool, relative: bool = False) -> dict[str, pa.Schema]:
    """The schemas by table, of a run of one body or of several, perhaps relative to one.

    In the order of writing: a pose's row never stands without the rows it was made from.
    """
    if not several:
        return SCHEMAS
    out = {name: pa.schema([(BODY, _S), *schema]) for name, schema in SCHEMAS.items()}
    poses = out.pop("poses")
    return out | ({"relative": RELATIVE_SCHEMA} if relative else {}) | {"poses": poses}


def csv_columns(several: bool) -> tuple[str, ...]:
    """The columns of `poses.csv`, of a run of one body or of several."""
    return (CSV_COLUMNS[0], BODY, *CSV_COLUMNS[1:]) if several else CSV_COLUMNS


def csv_heading(columns: Sequence[str]) -> bytes:
    """The first line of a table."""
    return ",".join(columns).encode() + b"\n"


Rows: TypeAlias = dict[str, list[dict[str, Any]]]
"""Rows by table."""


def frame_set_rows(
    bodies: Sequence[Body],
    measured: Sequence[Measurement],
    reference: str,
    cameras: Sequence[Camera],
) -> Rows:
    """A frame set's measurements, one of each body, as rows; also relative to a reference body."""
    rows: Rows = {}
    for body, one in zip(bodies, measured, strict=True):
        for name, some in _rows_of(one).items():
            for row in some if len(bodies) > 1 else ():
                row[BODY] = body.name
            rows.setdefault(name, []).extend(some)
    if reference:
        relative = relative_measurements(bodies, measured, reference, cameras)
        rows["relative"] = [
            {BODY: name, "reference": reference, **_pose_row(one)} for name, one in relative.items()
        ]
    return rows


def _rows_of(measured: Measurement) -> Rows:
    """A measurement as rows, by table; a frame set without a pose has a row all the same."""
    return {
        "detections": [_detection_row(measured, view) for view in measured.views],
        "balls": list(_ball_rows(measured)),
        "poses": [_pose_row(measured)],
    }


def csv_line(row: Mapping[str, Any], columns: Sequence[str] = CSV_COLUMNS) -> bytes:
    """A row of the table of poses as a line of `poses.csv`; empty cells where there is no pose."""
    row = {**row, "frame": row["index"], "codes": codes(map(Doubt.read, row["doubts"] or ()))}
    cells = [_cell(name, row[name]) for name in columns]
    line = StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue().encode()


def csv_lines(table: pa.Table, columns: Sequence[str]) -> Iterator[bytes]:
    """`csv_line` of each row of a stored table."""
    for batch in table.to_batches(max_chunksize=AT_ONCE):
        yield from (csv_line(row, columns) for row in batch.to_pylist())


def _cell(name: str, value: Any) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    if isinstance(value, float):
        # Times may count from 1970: no significant digits, but nanoseconds.
        return f"{value:.9f}" if name in _NINE_DECIMALS else f"{value:.6f}"
    return " ".join(value) if isinstance(value, tuple | list) else str(value)


def _detection_row(measured: Measurement, view: BallView) -> dict[str, Any]:
    row: dict[str, Any] = {
        "index": measured.index,
        "camera": view.camera,
        "ball": view.ball,
        "frame": measured.frames.get(view.camera),
        "state": view.state.value,
        "reason": view.reason.value,
    }
    if view.detection is None:
        return row
    seen = view.detection
    row["time_s"], row["radius_px"] = seen.time_s, seen.radius_px
    row["u_px"], row["v_px"] = seen.center_px.tolist()
    (row["var_uu_px2"], row["var_uv_px2"]), (_, row["var_vv_px2"]) = seen.covariance_px.tolist()
    row["score"], row["color_match"] = seen.score, seen.color_match
    residual = measured.residuals_px.get((view.ball, view.camera), _UNKNOWN)
    row["residual_u_px"], row["residual_v_px"] = residual.tolist()
    return row


def _ball_rows(measured: Measurement) -> Iterator[dict[str, Any]]:
    for position in measured.positions:
        yield {
            "index": measured.index,
            "ball": position.ball,
            "time_s": position.time_s,
            **dict(zip(PLACE[:3], map(float, position.center), strict=True)),
            "covariance_mm2": position.covariance.ravel(),
            "rms_mm": position.rms_mm,
            "cameras": position.cameras,
            "dropped": position.dropped,
        }


def _pose_row(measured: Measurement) -> dict[str, Any]:
    """Its row of the table of poses."""
    return {
        "index": measured.index,
        "time_s": measured.time_s,
        "cameras": (),
        "balls": (),
        "flags": (),
        "status": measured.status.value,
        "reason": measured.reason,
        "doubts": [json.dumps(one.plain, ensure_ascii=False) for one in measured.doubts],
        **pose_columns(measured.pose),
    }


def doubts_of(poses: pa.Table) -> list[tuple[Doubt, ...]]:
    """Why each row of a table of poses (n,) is not `ok`, and notes.

    Of a run that an earlier version wrote the reasons as they stand.
    """
    given = zip(poses["doubts"].to_pylist(), poses["reason"].to_pylist(), strict=True)
    return [
        tuple(map(Doubt.of, filter(None, [reason]))) if own is None else tuple(map(Doubt.read, own))
        for own, reason in given
    ]


def codes(doubts: Iterable[Doubt]) -> list[str]:
    """Each code once."""
    return list(dict.fromkeys(one.code for one in doubts))


Texts: TypeAlias = NDArray[np.str_]


def numbers(table: pa.Table, *names: str) -> Floats:
    """One column as (n,), or several as (n, k); what is missing is NaN."""
    columns = [np.asarray(table[name].to_numpy(), dtype=np.float64) for name in names]
    return columns[0] if len(names) == 1 else np.stack(columns, axis=1)


def integers(table: pa.Table, name: str) -> Ints:
    """A column of whole numbers (n,); what is missing is -1."""
    return np.asarray(pc.fill_null(table[name], -1).to_numpy(), dtype=np.int64)


def texts(table: pa.Table, name: str) -> Texts:
    """A column of words (n,)."""
    return np.array(table[name].to_pylist(), dtype=np.str_)


def matrices(table: pa.Table, name: str, side: int) -> Floats:
    """A column of square matrices (n, side, side); what is missing is NaN."""
    column = pa.chunked_array(table[name]).combine_chunks()
    out = np.full((len(column), side**2), np.nan)
    here = np.asarray(column.is_valid().to_numpy(zero_copy_only=False))
    out[here] = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, side**2)
    return out.reshape(-1, side, side)

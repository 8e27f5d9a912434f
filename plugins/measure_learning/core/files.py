"""Data sets on disk: one Parquet file that explains itself, and a data card beside it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.host import Dataset, Turns
from measure.results import read_run
from measure.results.tables import PLACE
from measure.robots import StateSchema
from measure.session import read_trajectory
from measure_learning.core.assemble import PoseTrack, TrajectoryFacts
from measure_learning.core.scores import Score
from measure_learning.robots import ROBOT_KEY, feature_columns
from measure_learning.robots.headings import ToolHeadings
from measure_learning.robots.other_programs import read_samples
from measure_learning.robots.tables import Table
from measure_learning.robots.tool_poses import Angles, ToolReading, reading_of, tool_readings

_KEY = b"measure.schema"
_ERRORS = ("ex_mm", "ey_mm", "ez_mm")
_LABELS = ("ex", "ey", "ez")
_STILL_MM, _LEAST_TURN_DEG = 1.0, 3.0  # RMS, of a body's origin and of its turns
_LABEL_SD_MM = 0.1  # of those, which no column states
_OF_POSES = ("time_s", *PLACE, "position_sd_mm", "rotation_sd_deg", "rms_px", "status")
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_COVARIANCE = tuple(f"cov_{'xyz'[i]}{'xyz'[j]}_mm2" for i, j in _UPPER)
_TURNS = ("turn_x_rad", "turn_y_rad", "turn_z_rad")
_TURN_COVARIANCE = tuple(f"turn_cov_{'xyz'[i]}{'xyz'[j]}_rad2" for i, j in _UPPER)
_TURN_SD_DEG = 0.3  # per axis, of rotations, where no column states it


def covariance_columns(
    covariances: Floats, names: Sequence[str] = _COVARIANCE
) -> dict[str, Floats]:
    """Upper triangles of (n, 3, 3), in mm^2 or in the unit of other names of columns."""
    return {n: covariances[:, i, j] for n, (i, j) in zip(names, _UPPER, strict=True)}


def turn_columns(turns: Turns | None) -> dict[str, Floats]:
    """Errors of rotations, by the names of their columns; nothing if there are none."""
    if turns is None:
        return {}
    named = dict(zip(_TURNS, turns.vectors_rad.T, strict=True))
    return named | covariance_columns(turns.covariances, _TURN_COVARIANCE)


def _read_covariances(table: Table, names: Sequence[str]) -> Floats:
    out = np.empty((len(table), 3, 3))
    for (i, j), column in zip(_UPPER, table.numbers(*names).T, strict=True):
        out[:, i, j] = out[:, j, i] = column
    return out


def write_dataset(path: Path, data: Dataset, facts: Sequence[TrajectoryFacts], source: str) -> None:
    """Write `path` (Parquet) and its data card, `path` with the suffix `.card.json`."""
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Any] = {
        "trajectory": pa.array(np.array(data.names)[data.trajectory]).dictionary_encode(),
        "time_s": data.times_s,
        "usable": data.usable,
        **dict(zip(_ERRORS, data.errors_mm.T, strict=True)),
        **covariance_columns(data.covariances),
        **turn_columns(data.turns),
        **dict(zip(data.schema.names, data.states.T.astype(np.float32), strict=True)),
    }
    table = pa.table(columns).replace_schema_metadata(
        {_KEY: json.dumps(data.schema.to_dict()), ROBOT_KEY: data.schema.robot}
    )
    parquet.write_table(table, path, compression="zstd")
    card = {
        "source": source,
        "robot": data.schema.robot,
        "digest": data.digest(),
        "rows": len(data),
        "usable": int(data.usable.sum()),
        "features": [[feature.name, feature.unit] for feature in data.schema.features],
        "label": "measured minus reported position, mm",
        "error": asdict(Score.of(data.errors_mm[data.usable])),
        "trajectories": [asdict(fact) for fact in facts],
    }
    path.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")


def read_dataset(path: Path) -> Dataset:
    """Read what `write_dataset` wrote; EstimatorError if it is missing, damaged or other data."""
    if not path.exists():
        raise EstimatorError(f"{path}: no such data set")
    table = Table.read(path)
    text = table.metadata(_KEY)
    if not text:
        raise EstimatorError(
            f"{path}: a table, but not a data set: make one with `measure dataset`"
        )
    schema = StateSchema.from_dict(json.loads(text))
    names, trajectory = _encode(table.labels("trajectory"))
    usable = table.numbers("usable")[:, 0]
    if not np.isin(usable, (0, 1)).all():
        raise EstimatorError(f"{path}: column 'usable' must say true or false in every row")
    data = Dataset(
        schema,
        table.numbers(*schema.names),
        table.numbers("time_s")[:, 0],
        trajectory,
        names,
        table.numbers(*_ERRORS),
        _read_covariances(table, _COVARIANCE),
        usable == 1,
    )
    if _TURNS[0] in table:
        spread = _read_covariances(table, _TURN_COVARIANCE)
        data = replace(data, turns=Turns(table.numbers(*_TURNS), spread))
    return _checked(path, data)


def read_labelled(path: Path, schema: StateSchema) -> Dataset:
    """A table that already pairs states with errors.

    Needs the columns `run`, `t_s`, `ex`, `ey`, `ez` (mm) and the schema's features, or others that
    hold them (`find_columns`); rows whose `quality`, if there is such a column, is not "ok" belong
    to the history only. Runs with one `restart` (or else `day`), where that column is there, count
    as one recording. `turn_x_rad` to `turn_z_rad`, if they are there, are errors of the rotation.
    """
    table = Table.read(path)
    table.require(("run", "t_s", *_LABELS))
    found = feature_columns(path, schema, table.schema.names)
    labels = table.labels("run")
    if group := next((name for name in ("restart", "day") if name in table), None):
        labels = [f"{of}/{run}" for of, run in zip(table.labels(group), labels, strict=True)]
    names, trajectory = _encode(labels)
    errors = table.numbers(*_LABELS)
    usable: Any = np.isfinite(errors).all(axis=1)
    if "quality" in table:
        usable = usable & np.array([word == "ok" for word in table.labels("quality")])
    size = float(np.median(np.linalg.norm(errors[usable], axis=1))) if usable.any() else 0.0
    if size < 0.03 or size > 200.0:
        raise EstimatorError(
            f"{path}: labels of {size:.2g} (median) are not millimetres of a robot's error: "
            "are they metres or micrometres?"
        )
    data = Dataset(
        schema,
        found.states(str(path), table.numbers(*found.columns)),
        table.numbers("t_s")[:, 0],
        trajectory,
        names,
        errors,
        np.tile(_LABEL_SD_MM**2 * np.eye(3), (len(trajectory), 1, 1)),
        usable,
    )
    if all(name in table for name in _TURNS):
        turns, variance = table.numbers(*_TURNS), np.deg2rad(_TURN_SD_DEG) ** 2
        if np.nanmedian(np.abs(turns)) > 1.0:
            raise EstimatorError(f"{path}: {_TURNS[0]} ... are not radians: are they degrees?")
        spread = np.tile(variance * np.eye(3), (len(turns), 1, 1))
        data = replace(data, turns=Turns(turns, spread))
    return _checked(path, data)


def _checked(path: Path, data: Dataset) -> Dataset:
    """The same data set, if it has rows, in time order, and what may be learnt from is numbers."""
    if not len(data):
        raise EstimatorError(f"{path}: holds no rows")
    for what, good in (
        ("state", np.isfinite(data.states).all(axis=1)),
        ("usable error", np.isfinite(data.errors_mm).all(axis=1) | ~data.usable),
        ("usable covariance", np.isfinite(data.covariances).all(axis=(1, 2)) | ~data.usable),
    ):
        if not good.all():
            row = int(np.argmin(good)) + 1
            raise EstimatorError(f"{path}: row {row} has a {what} that is no finite number")
    backwards = (np.diff(data.times_s) < 0) & (np.diff(data.trajectory) == 0)
    if backwards.any():
        row = int(np.argmax(backwards)) + 2
        name = data.names[data.trajectory[row - 1]]
        raise EstimatorError(
            f"{path}: time runs backwards at row {row}, in trajectory '{name}': sort its rows, or "
            "split it there"
        )
    return data


def has_labels(path: Path) -> bool:
    """Whether a table already holds errors beside states."""
    try:
        Table.read(path).require(("run", *_LABELS))
    except EstimatorError:
        return False
    return True


def read_poses(path: Path) -> PoseTrack:
    """Measured positions of a run folder, or of a `.csv` or `.parquet` file of positions.

    A file needs `time_s`, `x_mm`, `y_mm`, `z_mm`, and may give `qw`, `qx`, `qy`, `qz`, and
    `position_sd_mm` and `rotation_sd_deg` (3-D), else 0.1 mm and 0.3 deg per axis are assumed.
    Poses whose `status`, which runs have and files may have, is not "ok" count as not measured.
    Other programs' files of poses (TUM and what plugins of formats read) are taken as well.
    """
    if path.is_dir():
        return _run_poses(path)
    if not path.exists():
        raise EstimatorError(f"{path}: no such run or file of poses")
    table = Table.read(path)
    if not any(name in table for name in ("time_s", *PLACE[:3])):
        return _other_poses(path)
    return _poses_in(path, table, "time_s")


def _other_poses(path: Path) -> PoseTrack:
    known = read_trajectory(path, EstimatorError)
    count, poses = len(known.times_s), known.world_from_body
    return _ordered(path.stem, known.times_s, poses.translation, _stated(count), poses.rotation)


def read_stops(
    path: Path, schema: StateSchema, angles: Angles | None = None, *, eye_in_hand: bool = False
) -> tuple[PoseTrack, Floats | list[ToolReading]]:
    """Poses of a robot that stood still, and the states (n, features) in their rows.

    Where the table holds the tool's pose and no joints, these are its usual readings. Columns of
    poses are as `read_poses` knows them, without a time; all others are the robot's. Samples of
    easy_handeye2 and MoveIt are taken, too.
    """
    if not path.exists():
        raise EstimatorError(f"{path}: no such table of stops")
    if path.suffix in (".samples", ".yaml", ".yml"):
        return _samples(path, schema, eye_in_hand)
    table = Table.read(path)
    there = [name for name in table.schema.names if name not in _OF_POSES]
    track = _poses_in(path, table, None)
    if track.rotations is None:
        raise EstimatorError(f"{path}: lacks qw, qx, qy, qz beside x_mm, y_mm, z_mm")
    try:
        found = feature_columns(path, schema, there)
    except EstimatorError:
        if not ToolHeadings.of(there):
            raise
        return track, tool_readings(path, Table(path, table.content.select(there)), schema, angles)
    return track, found.states(str(path), table.numbers(*found.columns))


def _samples(
    path: Path, schema: StateSchema, eye_in_hand: bool
) -> tuple[PoseTrack, list[ToolReading]]:
    """Pairs of poses that another hand-eye program took."""
    samples = read_samples(path, eye_in_hand=eye_in_hand)
    seen = samples.cameras_from_marker
    count = len(seen.translation)
    track = _ordered(
        path.stem, np.arange(float(count)), seen.translation, _stated(count), seen.rotation
    )
    return track, [reading_of(path, samples.base_from_tool, schema, "as hand-eye programs do")]


def _stated(count: int) -> Floats:
    """Covariances (n, 6, 6) of poses without columns of them."""
    variances = np.repeat([_LABEL_SD_MM**2, np.deg2rad(_TURN_SD_DEG) ** 2], 3)
    return np.tile(np.diag(variances), (count, 1, 1))


def _poses_in(path: Path, table: Table, time: str | None) -> PoseTrack:
    """The poses of a table, at the times of a column, or numbered."""
    columns = table.numbers(*([time] if time else []), "x_mm", "y_mm", "z_mm")
    if time is None:
        columns = np.column_stack([np.arange(len(columns)), columns])
    variances = [
        _variance(table, "position_sd_mm", _LABEL_SD_MM),
        np.deg2rad(_variance(table, "rotation_sd_deg", _TURN_SD_DEG) ** 0.5) ** 2,
    ]
    P = np.repeat(np.stack(variances, axis=1), 3, axis=1)[:, :, None] * np.eye(6)
    turns = None
    if all(name in table for name in PLACE[3:]):
        quats = table.numbers(*PLACE[3:])
        known = np.linalg.norm(quats, axis=1) > 0.5  # not where it is NaN
        columns[~known, 1:] = np.nan
        turns = RigidTransform.from_quat_wxyz(
            np.where(known[:, None], quats, [1.0, 0, 0, 0]), np.zeros(3)
        ).rotation
        _check_metres(path, columns[known, 1:], turns[known])
    if not np.isfinite(columns[:, 0]).all():
        row = int(np.argmin(np.isfinite(columns[:, 0]))) + 1
        raise EstimatorError(f"{path}: row {row} has no time")
    positions = columns[:, 1:]
    if "status" in table:
        positions = _where_ok(positions, table.labels("status"))
    return _ordered(path.stem, columns[:, 0], positions, P, turns)


def _check_metres(path: Path, positions: Floats, turns: Floats) -> None:
    """Refuse (EstimatorError) a body that turns (n, 3, 3) and whose origin (n, 3) stays."""
    if not len(turns):
        return
    spread = np.linalg.norm(positions.std(axis=0))
    turned_deg = np.degrees(np.linalg.norm(turns.std(axis=0)) / np.sqrt(2))
    if spread < _STILL_MM and turned_deg > _LEAST_TURN_DEG:
        raise EstimatorError(
            f"{path}: the positions spread by {spread:.2g} mm while the body turns by "
            f"{turned_deg:.0f} deg (RMS): are they in metres? Convert them to mm"
        )


def _variance(table: Table, name: str, usual_sd: float) -> Floats:
    """Per axis (n,) of a 3-D standard deviation; that of `usual_sd` if there is no such column."""
    if name not in table:
        return np.full(len(table), usual_sd**2)
    sd = table.numbers(name)[:, 0]
    return np.asarray(np.where(np.isfinite(sd), sd, np.sqrt(3.0)) ** 2 / 3.0)


def _run_poses(path: Path) -> PoseTrack:
    run = read_run(path)
    count = len(run.times_s)
    positions, P = np.full((count, 3), np.nan), np.tile(np.eye(6), (count, 1, 1))
    turns = np.tile(np.eye(3), (count, 1, 1))
    positions[run.has_pose] = run.world_from_body.translation
    turns[run.has_pose] = run.world_from_body.rotation
    P[run.has_pose] = run.covariances
    positions = _where_ok(positions, run.poses["status"].to_pylist())
    return _ordered(path.name, run.times_s, positions, P, turns)


def _where_ok(positions: Floats, statuses: Sequence[str]) -> Floats:
    sure = np.array(statuses) == "ok"
    return np.where(sure[:, None], positions, np.nan)


def _ordered(
    name: str, times: Floats, positions: Floats, covariances: Floats, turns: Floats | None
) -> PoseTrack:
    """Rows in the order of time; covariances are (n, 6, 6)."""
    order = np.argsort(times, kind="stable")
    P = covariances[order]
    poses = (None, None) if turns is None else (turns[order], P)
    return PoseTrack(name, times[order], positions[order], P[:, :3, :3], *poses)


def _encode(labels: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    names = tuple(dict.fromkeys(labels))
    where = {name: index for index, name in enumerate(names)}
    return names, np.array([where[label] for label in labels], dtype=np.int64)

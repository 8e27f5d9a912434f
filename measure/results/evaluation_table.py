"""An evaluation as tables for people."""

from __future__ import annotations

import math
from dataclasses import dataclass

from measure.results.evaluation import RunEvaluation
from measure.results.statistics import AXES, Consistency, PositionErrors

Cell = str | float | int | None


@dataclass(frozen=True)
class TextTable:
    """A table: a title, headings with units, and rows."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]


def evaluation_tables(found: RunEvaluation) -> list[TextTable]:
    """The paper's Table I first, then what it leaves out."""
    kinds = (_table_one, _completeness, _rotation, _single_errors, _consistency, _noise)
    tables = [kind(found) for kind in kinds]
    return [table for table in tables if table.rows]


def _table_one(found: RunEvaluation) -> TextTable:
    rows: list[tuple[Cell, ...]] = [
        (axis, *_axis(found.ball, axis), *_axis(found.body, axis)) for axis in AXES
    ]
    rows.append(("3D", *_whole(found.ball), *_whole(found.body)))
    if found.aligned is not None:
        rows.append(("3D, world aligned", None, None, *_whole(found.aligned.body)))
    columns = ("axis", "ball RMS mm", "ball SD mm", "body RMS mm", "body SD mm")
    return TextTable("Error of single ball centres and of the body's origin", columns, rows)


def _completeness(found: RunEvaluation) -> TextTable:
    over_all = found.rms_all_frames_mm
    rms = "not finite: poses are missing" if math.isinf(over_all) else over_all
    rows: list[tuple[Cell, ...]] = [
        ("frame sets", found.frame_sets),
        ("compared with the truth", found.compared),
        ("without a pose", f"{found.without_pose} ({100 * found.failure_rate:.1f} %)"),
        ("outside the truth's time", found.outside_truth),
        ("body RMS over all of them, mm", rms),
    ]
    if found.body is not None:
        rows.append(("body 95 % within, mm", found.body.p95_3d_mm))
        rows.append(("body at most, mm", found.body.max_3d_mm))
    if found.body_ok is not None:
        rows.append(("body RMS of unflagged poses, mm", found.body_ok.rms_3d_mm))
    return TextTable("Completeness", ("what", "value"), rows)


def _rotation(found: RunEvaluation) -> TextTable:
    rows: list[tuple[Cell, ...]] = []
    aligned = None if found.aligned is None else found.aligned.rotation
    for name, turn in (("absolute", found.rotation), ("world aligned", aligned)):
        if turn is not None:
            rows.append((name, turn.rms_3d_deg, turn.sd_3d_deg, turn.max_3d_deg))
    return TextTable("Rotation", ("rotation", "RMS deg", "SD deg", "max deg"), rows)


def _single_errors(found: RunEvaluation) -> TextTable:
    rows: list[tuple[Cell, ...]] = []
    for name, kind in (("detection", found.detection), ("localisation", found.localisation)):
        if kind is None or (kind.ball is None and kind.pixels is None):
            continue
        pixels = None if kind.pixels is None else kind.pixels.rms_2d_px
        rows.append((name, pixels, *_whole(kind.ball), *_whole(kind.body)))
    columns = ("alone", "RMS px", "ball RMS mm", "ball SD mm", "body RMS mm", "body SD mm")
    return TextTable("Each error with the other switched off", columns, rows)


def _consistency(found: RunEvaluation) -> TextTable:
    kinds: tuple[tuple[str, Consistency | None], ...] = (
        ("ball position", found.ball_consistency),
        ("body position", found.position_consistency),
        ("body pose, 6-D", found.pose_consistency),
    )
    rows: list[tuple[Cell, ...]] = [
        (name, kind.count, f"{100 * kind.inside_95:.1f} %", kind.normalised_squared_error)
        for name, kind in kinds
        if kind is not None
    ]
    columns = ("covariance of", "count", "in 95 % region", "normalised error^2 (1 is right)")
    return TextTable("Do the reported covariances hold?", columns, rows)


def _noise(found: RunEvaluation) -> TextTable:
    noise = found.noise
    title = "Noise and drift" if noise is None else f"Noise and drift about {noise.about}"
    rows: list[tuple[Cell, ...]] = [] if noise is None else [*noise.rows()]
    return TextTable(title, ("unflagged poses", "position mm", "rotation deg"), rows)


def _axis(errors: PositionErrors | None, axis: str) -> tuple[float | None, float | None]:
    return (None, None) if errors is None else (errors.rms_mm[axis], errors.sd_mm[axis])


def _whole(errors: PositionErrors | None) -> tuple[float | None, float | None]:
    return (None, None) if errors is None else (errors.rms_3d_mm, errors.sd_3d_mm)

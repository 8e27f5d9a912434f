"""A run against the truth: the paper's Table I, and what it leaves out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import DegenerateGeometryError, RunError
from measure.geometry import RigidTransform, align_points
from measure.metrology.noise import Noise
from measure.model import Camera
from measure.results import single_errors
from measure.results.pose_table import noise_about
from measure.results.run import Run
from measure.results.statistics import (
    AXES,
    Consistency,
    PositionErrors,
    RotationErrors,
    consistency,
    position_errors,
    rotation_errors,
)
from measure.results.tables import integers, matrices, numbers, texts
from measure.results.truth_alignment import FAR_DEG, FAR_MM, TruthOffset, align_truth, mirror_notes
from measure.session import Trajectory

_FEWEST_ROWS = 3  # Of the truth within a run: fewer tell nothing of the motion between them
_ALIKE_RATIO = 1.25  # Of standard deviations: thirty errors tell no smaller one
_STILL_MM = 1.0  # A body that moves less between two rows may be interpolated anyhow


@dataclass(frozen=True)
class Aligned:
    """Errors after the one rigid motion of the world that fits the run to the truth best."""

    body: PositionErrors  # position errors that are left
    rotation: RotationErrors  # rotation errors that are left
    shift_mm: float  # length of the motion's shift at the middle of the positions
    turn_deg: float  # angle of the motion's rotation


@dataclass(frozen=True)
class RunEvaluation:
    """How good a run is."""

    frame_sets: int  # of the run
    compared: int  # with a pose at a time at which the truth is known
    without_pose: int  # frame sets at such times without a pose; `failure_rate` is their share
    outside_truth: int  # frame sets at times at which the truth is not known
    failure_rate: float  # see `without_pose`
    # RMS in 3-D over all frame sets the truth covers: infinite as soon as one of them has no pose,
    # for a missing pose is no small error.
    rms_all_frames_mm: float
    body: PositionErrors | None  # errors of the body's origin, over the frame sets compared
    body_ok: PositionErrors | None  # the same, without those the run itself flags as doubtful
    ball: PositionErrors | None  # errors of single ball centres as triangulated, all balls together
    balls: dict[str, PositionErrors | None]  # the same, by ball
    rotation: RotationErrors | None  # errors of the body's rotation
    position_consistency: Consistency | None  # of the positions with their covariances
    # the same, with the uncertainty of the world's scale added to the covariances.
    scaled_consistency: Consistency | None
    pose_consistency: Consistency | None  # of the whole poses with their 6x6 covariances
    ball_consistency: Consistency | None  # of the single balls
    aligned: Aligned | None  # errors relative to the best rigid motion of the world
    detection: single_errors.SingleErrors | None  # errors of detection alone
    # errors of camera localisation alone; None if the true cameras are not given.
    localisation: single_errors.SingleErrors | None
    # how the truth's clock was found, where that was asked for.
    truth_offset: TruthOffset | None = None
    notes: tuple[str, ...] = ()  # what to doubt about this comparison
    noise: Noise | None = None  # of the unflagged poses about the truth, and their drift


def evaluate(
    run: Run,
    truth: Trajectory,
    true_cameras: Sequence[Camera] | None = None,
    marks: single_errors.Marks | None = None,
    find_offset: bool = False,
) -> RunEvaluation:
    """Compare a run with the truth; each pose at its own time, the truth interpolated.

    True cameras, if these are known better than by the run's own calibration, separate errors of
    detection from errors of localisation; with marks (see `read_marks`) detection is compared with
    these. `find_offset` finds the truth's clock by motion, and fits its frames if they are others.
    RunError: the truth is of another time or in another unit, the motion does not tell its clock,
    or the true cameras lack one.
    """
    truth, offset = align_truth(run, truth) if find_offset else (truth, None)
    covered = _covered(run, truth)
    here = covered & run.has_pose
    measured, true = _pairs(run, truth, here)
    errors = measured.difference(true)
    covariances = run.covariances[here[run.has_pose]]
    by_scale = run.scale_sd**2 * np.einsum("ni,nj->nij", *[measured.translation] * 2)
    missing = int((covered & ~run.has_pose).sum())
    ball_names, ball_errors, ball_covariances = _ball_errors(run, truth)
    body = position_errors(errors[:, :3])
    detection, localisation = _errors_apart(run, truth, true_cameras, marks)
    return RunEvaluation(
        frame_sets=len(run.times_s),
        compared=int(here.sum()),
        without_pose=missing,
        outside_truth=int((~covered).sum()),
        failure_rate=missing / int(covered.sum()),
        rms_all_frames_mm=float("inf") if missing or body is None else body.rms_3d_mm,
        body=body,
        body_ok=position_errors(errors[run.unflagged[here], :3]),
        ball=position_errors(ball_errors),
        balls={n: position_errors(ball_errors[ball_names == n]) for n in run.body.names},
        rotation=rotation_errors(errors[:, 3:]),
        position_consistency=consistency(errors[:, :3], covariances[:, :3, :3]),
        scaled_consistency=consistency(errors[:, :3], covariances[:, :3, :3] + by_scale),
        pose_consistency=consistency(errors, covariances),
        ball_consistency=consistency(ball_errors, ball_covariances),
        aligned=_aligned(run, measured, true),
        detection=detection,
        localisation=localisation,
        truth_offset=offset,
        notes=(
            *truth.notes,
            *(() if offset is None else (offset.note(),)),
            *_notes(run, errors, missing, marks, true_cameras is None),
            *mirror_notes(truth.source, measured, true),
        ),
        noise=noise_about(run, _of_all(here, errors)),
    )


def _errors_apart(
    run: Run,
    truth: Trajectory,
    true_cameras: Sequence[Camera] | None,
    marks: single_errors.Marks | None,
) -> tuple[single_errors.SingleErrors | None, single_errors.SingleErrors | None]:
    """Errors of detection alone, and of camera localisation alone."""
    cameras = _checked_cameras(run, true_cameras)
    if marks is not None:
        detection = single_errors.detection_errors_by_marks(run, marks)
    else:
        detection = single_errors.detection_errors_by_truth(run, truth, cameras or run.cameras)
    if not cameras:
        return detection, None
    return detection, single_errors.localisation_errors_by_truth(run, truth, cameras)


def _covered(run: Run, truth: Trajectory) -> Bools:
    """Which frame sets the truth covers (n,); refused if there is none."""
    if not len(run.times_s):
        raise RunError(f"{run.path} holds no frame set yet: there is nothing to compare")
    covered = truth.covers(run.times_s)
    if not covered.any():
        theirs, ours = (f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (truth.times_s, run.times_s))
        raise RunError(
            f"{truth.source} runs from {theirs}, at no time together with {run.path} ({ours}): it "
            "is not its truth, or on another clock (--find-offset finds it by motion)"
        )
    _check_rows(run, truth)
    return covered


def _check_rows(run: Run, truth: Trajectory) -> None:
    """Refuse a truth whose rows are too few for the motion between them, as of a wrong unit."""
    begin, end = np.searchsorted(truth.times_s, [run.times_s[0], run.times_s[-1]])
    around = slice(max(int(begin) - 1, 0), int(end) + 1)
    places = truth.world_from_body.translation[around]
    few = len(run.times_s) >= _FEWEST_ROWS > end - begin
    if few and np.ptp(places, axis=0).max() > _STILL_MM:
        step_s = float(np.median(np.diff(truth.times_s[around])))
        raise RunError(
            f"{run.path} ({run.times_s[0]:.3f} to {run.times_s[-1]:.3f} s) lies between "
            f"{len(places)} rows of {truth.source}, which are {step_s:.4g} s apart: that is no "
            "comparison. Are its times in seconds, and on this clock?"
        )


def pose_errors(run: Run, truth: Trajectory) -> Floats:
    """Measured against true poses of all frame sets (n, 6) in the `perturb` chart.

    NaN where a frame set has no pose or lies outside the truth's time. RunError: the truth is of
    another time or unit.
    """
    here = _covered(run, truth) & run.has_pose
    measured, true = _pairs(run, truth, here)
    return _of_all(here, measured.difference(true))


def _of_all(here: Bools, errors: Floats) -> Floats:
    """Errors (n, 6) of all frame sets by those of the ones `here` (n,); NaN for the others."""
    out = np.full((len(here), 6), np.nan)
    out[here] = errors
    return out


def _pairs(run: Run, truth: Trajectory, here: Bools) -> tuple[RigidTransform, RigidTransform]:
    """Measured and true poses of the frame sets `here`, which have both; refused in another unit.

    Positions a hundred times as large, or less than a hundredth, are in another unit.
    """
    which, poses = here[run.has_pose], run.world_from_body
    measured = RigidTransform(poses.rotation[which], poses.translation[which])
    true = truth.at(run.times_s[here])
    if not here.any():
        return measured, true
    ours, theirs = (
        float(np.median(np.linalg.norm(one.translation, axis=1))) for one in (measured, true)
    )
    if max(ours, theirs) > 1.0 and not 0.01 < (ours + 1e-3) / (theirs + 1e-3) < 100:
        raise RunError(
            f"{truth.source} has positions of about {theirs:.3g}, {run.path} of {ours:.3g} mm: "
            "the truth must be in mm (x_mm, y_mm, z_mm)"
        )
    return measured, true


def _ball_errors(run: Run, truth: Trajectory) -> tuple[np.ndarray, Floats, Floats]:
    table = run.balls
    times = numbers(table, "time_s")
    known = truth.covers(times) if len(times) else np.zeros(0, bool)
    names = texts(table, "ball")[known]
    found = numbers(table, "x_mm", "y_mm", "z_mm")[known]
    covariances = matrices(table, "covariance_mm2", 3)[known]
    if not len(found):
        return names, found.reshape(-1, 3), covariances
    places = run.body.centers[[run.body.index(name) for name in names]]
    return names, found - truth.at(times[known]).apply(places), covariances


def _aligned(run: Run, measured: RigidTransform, true: RigidTransform) -> Aligned | None:
    if len(measured.translation) < 3:
        return None
    ours = np.concatenate([measured.apply(center) for center in run.body.centers])
    theirs = np.concatenate([true.apply(center) for center in run.body.centers])
    try:
        world_from_run = align_points(theirs, ours)
    except DegenerateGeometryError:
        return None
    left = (world_from_run @ measured).difference(true)
    body, rotation = position_errors(left[:, :3]), rotation_errors(left[:, 3:])
    assert body is not None
    assert rotation is not None
    middle = measured.translation.mean(axis=0)
    shift = np.linalg.norm(world_from_run.apply(middle) - middle)
    turn = np.rad2deg(np.linalg.norm(world_from_run.rotvec))
    return Aligned(body, rotation, float(shift), float(turn))


def _checked_cameras(run: Run, cameras: Sequence[Camera] | None) -> Sequence[Camera] | None:
    if cameras is None:
        return None
    names = [camera.name for camera in cameras]
    for camera in run.cameras:
        if camera.name not in names:
            raise RunError(
                f"the true cameras lack '{camera.name}' of {run.path}; there is {', '.join(names)}"
            )
    return cameras


def _notes(
    run: Run, errors: Floats, missing: int, marks: single_errors.Marks | None, cameras_unknown: bool
) -> tuple[str, ...]:
    """What to doubt, where the poses compared have these errors (n, 6)."""
    far_mm, far_rad = (
        float(np.median(np.linalg.norm(part, axis=1))) if len(part) else 0.0
        for part in (errors[:, :3], errors[:, 3:])
    )
    notes = []
    if missing:
        notes.append(
            f"{missing} frame sets have no pose: the RMS over the others says nothing about them"
        )
    if far_mm > FAR_MM:
        notes.append(
            f"half of the poses are more than {far_mm:.0f} mm off: is this the truth of this "
            "session?"
        )
    if marks is not None and (over := single_errors.passed_over(run, marks)):
        notes.append(
            f"{over} of {len(marks)} marks are of frames that the run has not: passed over"
        )
    if marks is None and cameras_unknown:
        notes.append("detection alone: the run's own cameras are taken as exact")
    if not run.finished:
        notes.append("the run is not finished")
    flagged = int((texts(run.poses, "status") == "flagged").sum())
    if flagged:
        notes.append(f"{flagged} poses are flagged as doubtful by the run itself")
    first = integers(run.poses, "index")
    if len(first) and first[0] != 0:
        notes.append(f"the run begins at frame set {first[0]}")
    if np.rad2deg(far_rad) > FAR_DEG:
        notes.append(
            f"half of the rotations are more than {np.rad2deg(far_rad):.0f} deg off: does the "
            "truth give world_from_body, and its quaternions in the order of their headings?"
        )
    return tuple(notes)


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
        ("body position, with the world's scale", found.scaled_consistency),
        ("body pose, 6-D", found.pose_consistency),
    )
    rows: list[tuple[Cell, ...]] = [
        (
            name,
            kind.count,
            f"{100 * kind.inside_95:.1f} %",
            kind.normalised_squared_error,
            _stated_against_shown(kind.normalised_squared_error),
        )
        for name, kind in kinds
        if kind is not None
    ]
    columns = (
        *("covariance of", "count", "in 95 % region", "normalised error^2 (1 is right)"),
        "stated against the errors of this recording",
    )
    return TextTable("Do the reported covariances hold?", columns, rows)


def _stated_against_shown(normalised_squared_error: float) -> str:
    """How large the stated deviations are beside the errors, in words."""
    ratio = 1 / math.sqrt(max(normalised_squared_error, 1e-12))
    if 1 / _ALIKE_RATIO < ratio < _ALIKE_RATIO:
        return "alike"
    return f"{ratio:.2g} times: " + ("on the safe side" if ratio > 1 else "too small")


def _noise(found: RunEvaluation) -> TextTable:
    noise = found.noise
    title = "Noise and drift" if noise is None else f"Noise and drift about {noise.about}"
    rows: list[tuple[Cell, ...]] = [] if noise is None else [*noise.rows()]
    return TextTable(title, ("unflagged poses", "position mm", "rotation deg"), rows)


def _axis(errors: PositionErrors | None, axis: str) -> tuple[float | None, float | None]:
    return (None, None) if errors is None else (errors.rms_mm[axis], errors.sd_mm[axis])


def _whole(errors: PositionErrors | None) -> tuple[float | None, float | None]:
    return (None, None) if errors is None else (errors.rms_3d_mm, errors.sd_3d_mm)

"""What is made of a run: its evaluation, its report, and files for other programs."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.api.outputs import output
from measure.errors import MeasureError, RunError
from measure.results import Run, RunEvaluation, read_marks, read_run, read_runs
from measure.results import evaluate as evaluate_run
from measure.results.evaluation import pose_errors
from measure.results.exporting import export_run
from measure.results.folder import own_files
from measure.session import (
    open_session,
    read_calibration,
    read_robot_base,
    read_trajectory,
    session_truth,
)

_log = logging.getLogger(__name__)


def evaluate(
    run: Path | str,
    truth: Path | str | None = None,
    calibration: Path | str | None = None,
    marks: Path | str | None = None,
    *,
    find_offset: bool = False,
    truth_body: str | None = None,
    body: str | None = None,
) -> RunEvaluation:
    """Compare a run with the truth: Table I of the paper, and what it leaves out.

    Args:
        truth: poses over time; those of the run's session if omitted.
        calibration: where the cameras really are, if that is known; separates errors of detection
            from errors of camera localisation.
        marks: ball centres marked by hand (camera,frame,ball,u_px,v_px); detection is compared with
            these.
        find_offset: find the clock of a truth of another system by motion, and fit its frames.
        truth_body: which rigid body of a tracker's file, or of a table of several bodies; of a run
            of several bodies that of the body's own name if omitted.
        body: which body, of a run of several.
    """
    opened = read_run(Path(run), body)
    truth_body = truth_body or _own_name(opened)
    path = Path(truth) if truth is not None else _truth_of(opened)
    if path is None:
        raise RunError(f"the session of {run} has no truth: give one with --truth")
    cameras = None if calibration is None else read_calibration(calibration).cameras
    return evaluate_run(
        opened,
        read_trajectory(path, RunError, truth_body),
        cameras,
        None if marks is None else read_marks(marks, opened),
        find_offset,
    )


def body_names(run: Path | str) -> list[str]:
    """Names of the bodies that a run measured; RunError: no run, or a damaged one."""
    return [one.body.name for one in read_runs(Path(run))]


def report(
    run_path: Path,
    out: Path | None = None,
    truth: Path | None = None,
    body: str | None = None,
    overwrite: bool = False,
    frame: Path | None = None,
) -> Path:
    """Write the report of a run as one self-contained HTML file; gives the file.

    Args:
        out: the file; `report.html` in the run's folder if omitted.
        truth: poses over time; those of the run's session if omitted and there are any.
        body: which body, of a run of several; all if omitted.
        frame: by `register`: poses and errors are shown in the axes of the robot's base.
    """
    from measure.viewing.report.run_report import run_report

    path = out or run_path / "report.html"
    with output(path, overwrite) as page:
        runs = _chosen(run_path, body)
        errors = []
        for run in runs:
            file = (truth or _truth_of(run)) if run.poses.num_rows else None
            true = None if file is None else read_trajectory(file, RunError, _own_name(run))
            errors.append(None if true is None else pose_errors(run, true))
        picture, axes = _picture(runs), "the cameras' world"
        if frame is not None:
            base_from_world, axes = read_robot_base(frame).inverse(), "the robot's base"
            runs = [run.in_frame(base_from_world) for run in runs]
            errors = [
                off if off is None else base_from_world.rotate(off.reshape(-1, 2, 3)).reshape(-1, 6)
                for off in errors
            ]
        made = run_report(runs, errors, picture, axes)
        # A folder may have a name that is no text.
        page.write_text(made, encoding="utf-8", errors="backslashreplace")
    return path


def _picture(runs: list[Run]) -> tuple[int, bytes] | None:
    """The frame set in which most views were used, as the cameras saw it; None if that is gone."""
    from measure.viewing.drawings import draw_mosaic, jpeg_of

    run, states = runs[0], pa.concat_tables([run.detections for run in runs])
    used = states.filter(pc.equal(states["state"], "effective"))["index"].to_numpy()
    if run.session is None or not len(used):
        return None
    most = np.bincount(used)
    best = np.flatnonzero(most == most.max())
    index = int(best[len(best) // 2])
    try:
        with open_session(run.session, run.path / "calibration.toml", run.body) as session:
            return index, jpeg_of(draw_mosaic(session, runs, index))
    except MeasureError as problem:
        _log.warning("no pictures in the report: %s", problem)
        return None


def export(
    run: Path | str,
    file_format: str,
    out: Path | str | None = None,
    overwrite: bool = False,
    body: str | None = None,
    *,
    smooth_s: float | None = None,
    velocity: bool = False,
) -> Path:
    """Write a run in another program's format; gives the file.

    Args:
        file_format: "csv", "tum", "trc", "c3d" or "mcap".
        out: the file to write; `export.FORMAT` in the run's folder if omitted.
        overwrite: replace what is there, but for the run's own files.
        body: which body, of a run of several; all if omitted.
        smooth_s: smooth poses over so long on either side; as measured if omitted.
        velocity: write velocities as well.
    """
    path = Path(run) / f"export.{file_format}" if out is None else Path(out)
    with output(path, overwrite, own_files(Path(run))) as file:
        export_run(_chosen(Path(run), body), file_format, file, smooth_s, velocity)
    return path


def _chosen(run: Path, body: str | None) -> list[Run]:
    """The runs of all bodies, or of one."""
    return read_runs(run) if body is None else [read_run(run, body)]


def _own_name(run: Run) -> str | None:
    """The name of the body in a table of several, None for a run of one."""
    return run.body.name if run.several else None


def _truth_of(run: Run) -> Path | None:
    """The truth of the session a run was made from, None if there is none."""
    return None if run.session is None else session_truth(run.session)

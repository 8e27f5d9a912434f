"""What is made of a run: its evaluation, its report, and files for other programs."""

from __future__ import annotations

import logging
from pathlib import Path

from measure.api.outputs import output
from measure.errors import RunError
from measure.results import Run, RunEvaluation, read_marks, read_run, read_runs
from measure.results import evaluate as evaluate_run
from measure.results.exporting import export_run
from measure.results.folder import own_files
from measure.session import read_calibration, read_trajectory, session_truth

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
    truth_body = truth_body or own_name(opened)
    path = Path(truth) if truth is not None else truth_of(opened)
    if path is None:
        raise RunError(f"the session of {run} has no truth: give one with --truth")
    cameras = None if calibration is None else read_calibration(calibration).cameras
    return evaluate_run(
        opened,
        read_trajectory(path, RunError, truth_body, opened.span_s),
        cameras,
        None if marks is None else read_marks(marks, opened),
        find_offset,
    )


def body_names(run: Path | str) -> list[str]:
    """Names of the bodies that a run measured; RunError: no run, or a damaged one."""
    return [one.body.name for one in read_runs(Path(run))]


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
    """Write a run in another program's format.

    Args:
        run: the run's folder.
        file_format: csv (poses with covariances), tum (evo; metres), trc (OpenSim markers), c3d
            (markers) or mcap (ROS 2; metres).
        out: the file to write; export.FORMAT in the run's folder if omitted.
        body: which body, of a run of several; all if omitted.
        smooth_s: smooth the unflagged poses by cubics over so many seconds on either side; they are
            as measured if omitted. Of csv, tum and mcap.
        velocity: write velocities as well, with their covariance. Of csv and mcap.

    Returns:
        The file.
    """
    path = Path(run) / f"export.{file_format}" if out is None else Path(out)
    with output(path, overwrite, own_files(Path(run))) as file:
        export_run(chosen_runs(Path(run), body), file_format, file, smooth_s, velocity)
    return path


def chosen_runs(run: Path, body: str | None) -> list[Run]:
    """The runs of all bodies, or of one."""
    return read_runs(run) if body is None else [read_run(run, body)]


def own_name(run: Run) -> str | None:
    """The name of the body in a table of several, None for a run of one."""
    return run.body.name if run.several else None


def truth_of(run: Run) -> Path | None:
    """The truth of the session a run was made from, None if there is none."""
    return None if run.session is None else session_truth(run.session)

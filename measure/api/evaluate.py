"""Comparing a run with the truth."""

from __future__ import annotations

from pathlib import Path

from measure.errors import RunError
from measure.results import Run, RunEvaluation, read_marks, read_run
from measure.results.evaluation import evaluate as evaluate_run
from measure.session import read_calibration, read_trajectory, session_truth


def evaluate(
    run: Path | str,
    truth: Path | str | None = None,
    calibration: Path | str | None = None,
    marks: Path | str | None = None,
) -> RunEvaluation:
    """Compare a run with the truth: Table I of the paper, and what it leaves out.

    Args:
        run: the run's folder, finished or not.
        truth: poses over time; those of the run's session if omitted.
        calibration: where the cameras really are, if that is known; separates errors of detection
            from errors of camera localisation.
        marks: ball centres marked by hand (camera,frame,ball,u_px,v_px); detection is compared with
            these.

    Raises:
        RunError: no run, no truth, or a truth of another time or unit.
    """
    opened = read_run(Path(run))
    path = Path(truth) if truth is not None else truth_of(opened)
    if path is None:
        raise RunError(f"the session of {run} has no truth: give one with --truth")
    cameras = None if calibration is None else read_calibration(calibration).cameras
    return evaluate_run(
        opened,
        read_trajectory(path, RunError),
        cameras,
        None if marks is None else read_marks(marks, opened),
    )


def truth_of(run: Run) -> Path | None:
    """The truth of the session a run was made from, None if there is none."""
    return None if run.session is None else session_truth(run.session)

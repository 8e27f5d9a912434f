"""A run's report, as one file."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from measure.api.outputs import output
from measure.api.results import chosen_runs, own_name, truth_of
from measure.arrays import Floats
from measure.errors import MeasureError, RunError
from measure.results import Run
from measure.results.evaluation import pose_errors
from measure.session import open_session, read_robot_base, read_trajectory

_log = logging.getLogger(__name__)


def report(
    run: Path,
    out: Path | None = None,
    truth: Path | None = None,
    body: str | None = None,
    overwrite: bool = False,
    frame: Path | None = None,
) -> Path:
    """Write a run's report as one HTML file.

    Everything is inside the file: it can be mailed, and opens without a network.

    Args:
        run: the run's folder.
        out: the file to write; report.html in the run's folder if omitted.
        truth: a trajectory to compare with; the session's own if omitted.
        body: which body, of a run of several; all if omitted.
        frame: written by `measure register`: show poses in the axes of the robot's base.

    Returns:
        The file.
    """
    from measure_lab.run_report import run_report

    path = out or run / "report.html"
    with output(path, overwrite) as page:
        runs = chosen_runs(run, body)
        errors = list[Floats | None]()
        for one in runs:
            file = (truth or truth_of(one)) if one.poses.num_rows else None
            errors.append(None)
            if file is not None:
                true = read_trajectory(file, RunError, own_name(one), one.span_s)
                errors[-1] = pose_errors(one, true)
        picture, axes = _picture(runs), "the cameras' world"
        if frame is not None:
            base_from_world, axes = read_robot_base(frame).inverse(), "the robot's base"
            runs = [one.in_frame(base_from_world) for one in runs]
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

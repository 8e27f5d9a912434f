"""A recording for the viewer of a robot beside its measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.api.correcting import model_file
from measure.api.outputs import check_writable
from measure.api.pairing import read_tracks
from measure.arrays import Floats, Ints
from measure.errors import ConfigError
from measure.host import OnnxModel
from measure.results import Run, read_run
from measure.robots import find_schema
from measure.session import open_session


def robot_recording(
    run: Path,
    robot: str,
    log: Path | None = None,
    model: Path | None = None,
    frame: Path | None = None,
    clock_offset_s: float | None = None,
) -> Path:
    """Write a robot's reported, measured and corrected positions into the run's `robot.rrd`.

    Args:
        robot: name of a state schema, or a robot.toml.
        log: the robot's log; the session's own if omitted.
        model: an estimator (.onnx), or `shipped`, that corrects the reported positions.
        frame: where the robot is, by `register`; its base is the cameras' world if omitted.
        clock_offset_s: robot minus camera time; estimated from the motion if absent.

    Returns:
        The recording.

    Raises:
        RunError: the folder is no run.
        ConfigError: there is no log.
        EstimatorError: log, model and poses do not fit together.
    """
    from measure.learning.traces import robot_traces
    from measure.viewing.robot_recording import write_robot_recording

    check_writable(run / "robot.rrd")
    measured = read_run(run)
    log = log or _log_of(measured)
    if log is None:
        raise ConfigError(f"the session of {run} names no robot log: give it with --robot-log")
    estimator = None if model is None else OnnxModel.load(model_file(model))
    schema = find_schema(robot)
    (track,) = read_tracks([run], frame, schema.robot)
    traces = robot_traces(track, log, schema, estimator, clock_offset_s)
    frames = measured.poses["index"].to_numpy()[_nearest(measured.times_s, traces.times_s)]
    path = run / "robot.rrd"
    write_robot_recording(path, f"{run.resolve().name}: robot", frames, traces)
    return path


def _nearest(times_s: Floats, at_s: Floats) -> Ints:
    """Which of increasing times (n,) is nearest to each of others (m,); the earlier of two."""
    # Not by all differences: robots report a thousand states a second.
    right = np.minimum(np.searchsorted(times_s, at_s), len(times_s) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(at_s - times_s[left] <= times_s[right] - at_s, left, right)


def _log_of(run: Run) -> Path | None:
    """The robot log that a run's session names, if the session is still there."""
    if run.session is None:
        return None
    with open_session(run.session) as opened:
        return opened.robot_log

"""A robot registered to the cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from measure.api.pairing import open_logs
from measure.errors import ConfigError, EstimatorError

if TYPE_CHECKING:
    from measure.learning.frames import RobotFrame
    from measure.learning.registration import RegisterOptions


def register(
    runs: Sequence[Path],
    logs: Sequence[Path],
    robot: str,
    options: RegisterOptions,
    *,
    topic: str | None = None,
) -> RobotFrame:
    """Where a robot's base, the body on its tool and its clock are, from runs and logs.

    Args:
        runs: run folders, or tables of poses; the cameras and the body stayed where they were.
        logs: robot logs, one for each run or one for all.
        robot: name of a state schema, or a robot.toml.
        topic: of the state messages, if a log is a bag.

    Raises:
        ConfigError: no runs, or no logs.
        EstimatorError: files that do not fit, or a motion that does not show it.
    """
    from measure.learning import files
    from measure.learning.registration import Recording, register
    from measure.results import read_run
    from measure.results.pose_table import shared_errors
    from measure.robots import find_schema

    if not (runs and logs):
        raise ConfigError("give runs of the moving robot, and its log with --robot-log")
    tracks = [files.read_poses(run) for run in runs]
    if len({track.name for track in tracks}) < len(tracks):
        raise EstimatorError("two recordings have the same name: rename one")
    shared = [shared_errors(read_run(run)) if run.is_dir() else None for run in runs]
    opened = open_logs(runs, logs, find_schema(robot), topic)
    return register(list(map(Recording, tracks, opened, shared)), options)

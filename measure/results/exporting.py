"""A run in other programs' formats; the libraries one needs are imported when it is written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from measure.errors import ConfigError, RunError
from measure.results.pose_table import Velocities, smooth_run
from measure.results.run import Run
from measure.session import Format, format_for, formats


def export_run(
    runs: Sequence[Run],
    file_format: str,
    path: Path,
    smooth_s: float | None = None,
    velocity: bool = False,
) -> Path:
    """Write a run, of each body or of one, in a format of another program; gives the file written.

    Poses are smoothed over `smooth_s` on either side; as measured if omitted. ConfigError: no such
    format, it cannot hold what is asked, or its library is missing. RunError: it cannot be written,
    or the run holds no pose.
    """
    chosen = format_for("write_run", file_format)
    if not any(run.has_pose.any() for run in runs):
        raise RunError(f"{runs[0].path} holds no pose: there is nothing to export")
    assert chosen.write_run is not None
    _refuse_what_it_cannot_hold(chosen, smooth_s is not None, velocity)
    velocities: list[Sequence[Velocities]] = []
    if smooth_s is not None or velocity:
        smoothed = [smooth_run(run, smooth_s) for run in runs]
        runs = [run for run, _ in smoothed]
        velocities = [[moving for _, moving in smoothed]] if velocity else []
    try:
        chosen.write_run(runs, path, *velocities)
    except ModuleNotFoundError as problem:
        raise ConfigError(
            f"writing {file_format} needs {problem.name}: install it with "
            f'pip install "triball[{chosen.extra}]"'
        ) from None
    except OSError as problem:
        raise RunError(f"{path}: cannot be written: {problem.strerror or problem}") from None
    return path


def _refuse_what_it_cannot_hold(chosen: Format, smooth: bool, velocity: bool) -> None:
    known = [one for one in formats().values() if one.write_run]
    if smooth and not chosen.holds_poses:
        others = " and ".join(one.name for one in known if one.holds_poses)
        raise ConfigError(f"{chosen.name} holds balls as located: --smooth is for {others}")
    if velocity and not chosen.holds_velocity:
        others = " or ".join(one.name for one in known if one.holds_velocity)
        raise ConfigError(f"{chosen.name} has no place for --velocity: export {others}")

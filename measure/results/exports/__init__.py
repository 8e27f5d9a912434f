"""A run in other programs' formats; the libraries one needs are imported when it is written."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from measure.errors import ConfigError, RunError
from measure.results.exports import mcap, tables
from measure.results.pose_table import Velocities, smooth_run
from measure.results.run import Run


@dataclass(frozen=True)
class Format:
    """A format."""

    write: Callable[..., None]  # takes runs, a path and, if it holds velocities, these or nothing
    extra: str = ""  # that must be installed
    smooth: bool = True  # whether it holds poses, which can be smoothed
    velocity: bool = False  # whether it holds velocities


FORMATS = {
    "csv": Format(tables.write_csv, velocity=True),
    "tum": Format(tables.write_tum),
    "trc": Format(tables.write_trc, smooth=False),
    "c3d": Format(tables.write_c3d, extra="c3d", smooth=False),
    "mcap": Format(mcap.write, extra="ros", velocity=True),
}


def export_run(
    runs: Sequence[Run],
    file_format: str,
    path: Path,
    smooth_s: float | None = None,
    velocity: bool = False,
) -> Path:
    """Write a run, of each body or of one, in one of `FORMATS`; gives the file written.

    Poses are smoothed over `smooth_s` on either side; as measured if omitted. ConfigError: no such
    format, it cannot hold what is asked, or its library is missing. RunError: it cannot be written,
    or the run holds no pose.
    """
    if file_format not in FORMATS:
        near = difflib.get_close_matches(file_format, FORMATS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(FORMATS)}"
        raise ConfigError(f"no export format is called '{file_format}'; {hint}")
    if not any(run.has_pose.any() for run in runs):
        raise RunError(f"{runs[0].path} holds no pose: there is nothing to export")
    chosen = FORMATS[file_format]
    _refuse_what_it_cannot_hold(file_format, smooth_s is not None, velocity)
    velocities: list[Sequence[Velocities]] = []
    if smooth_s is not None or velocity:
        smoothed = [smooth_run(run, smooth_s) for run in runs]
        runs = [run for run, _ in smoothed]
        velocities = [[moving for _, moving in smoothed]] if velocity else []
    try:
        chosen.write(runs, path, *velocities)
    except ModuleNotFoundError as problem:
        raise ConfigError(
            f"writing {file_format} needs {problem.name}: install it with "
            f'pip install "triball[{chosen.extra}]"'
        ) from None
    except OSError as problem:
        raise RunError(f"{path}: cannot be written: {problem.strerror or problem}") from None
    return path


def _refuse_what_it_cannot_hold(file_format: str, smooth: bool, velocity: bool) -> None:
    chosen = FORMATS[file_format]
    if smooth and not chosen.smooth:
        raise ConfigError(
            f"{file_format} holds balls as located: --smooth is for csv, tum and mcap"
        )
    if velocity and not chosen.velocity:
        raise ConfigError(f"{file_format} has no place for --velocity: export csv or mcap")

"""A run in other programs' formats; the libraries one needs are imported when it is written."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from measure.errors import ConfigError, RunError
from measure.results.exports import markers, mcap, poses
from measure.results.folder import own_files
from measure.results.run import Run


@dataclass(frozen=True)
class Format:
    """A format: the function that writes it, and the extra that must be installed."""

    write: Callable[[Sequence[Run], Path], None]
    extra: str = ""


FORMATS = {
    "csv": Format(poses.write_csv),
    "tum": Format(poses.write_tum),
    "trc": Format(markers.write_trc),
    "c3d": Format(markers.write_c3d, extra="c3d"),
    "mcap": Format(mcap.write, extra="ros"),
}


def export_run(runs: Sequence[Run], file_format: str, path: Path, overwrite: bool = False) -> Path:
    """Write a run in another program's format.

    Args:
        runs: of each body of a run, finished or not.
        file_format: one of `FORMATS`.
        path: the file to write.
        overwrite: replace a file that is there.

    Returns:
        The file written.

    Raises:
        ConfigError: no such format, or its library is not installed.
        RunError: the file is there already or one of the run's own, cannot be written, or the run
            holds no pose.
    """
    if file_format not in FORMATS:
        near = difflib.get_close_matches(file_format, FORMATS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(FORMATS)}"
        raise ConfigError(f"no export format is called '{file_format}'; {hint}")
    if path.is_symlink():
        raise RunError(f"{path} is a link to {path.readlink()}: give the file itself with --out")
    if path.exists() and any(
        own.exists() and path.samefile(own) for own in own_files(runs[0].path)
    ):
        raise RunError(f"{path} is a file of the run itself: give another with --out")
    if path.exists() and not overwrite:
        raise RunError(f"{path} is there already; --overwrite replaces it")
    if not any(run.has_pose.any() for run in runs):
        raise RunError(f"{runs[0].path} holds no pose: there is nothing to export")
    chosen = FORMATS[file_format]
    try:
        chosen.write(runs, path)
    except ModuleNotFoundError as problem:
        raise ConfigError(
            f"writing {file_format} needs {problem.name}: install it with "
            f'pip install "triball[{chosen.extra}]"'
        ) from None
    except OSError as problem:
        raise RunError(f"{path}: cannot be written: {problem.strerror or problem}") from None
    return path

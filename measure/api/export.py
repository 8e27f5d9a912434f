"""Writing a run in another program's format."""

from __future__ import annotations

from pathlib import Path

from measure.results import read_run
from measure.results.exports import export_run


def export(
    run: Path | str, file_format: str, out: Path | str | None = None, overwrite: bool = False
) -> Path:
    """Write a run in another program's format.

    Args:
        run: the run's folder, finished or not.
        file_format: "csv", "tum", "trc", "c3d" or "mcap".
        out: the file to write; `export.FORMAT` in the run's folder if omitted.
        overwrite: replace a file that is there.

    Returns:
        The file written.

    Raises:
        ConfigError: no such format, or its library is not installed.
        RunError: no run, no pose in it, or the file cannot be written.
    """
    opened = read_run(Path(run))
    path = Path(run) / f"export.{file_format}" if out is None else Path(out)
    return export_run(opened, file_format, path, overwrite)

"""`measure export`: a run in another program's format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag
from measure.cli.options import command

_FORMAT = Annotated[str, Parameter(name=("--format", "-f"))]
_SMOOTH = Annotated[float | None, Parameter(name="--smooth")]


@command(api.export, file_format=_FORMAT, smooth_s=_SMOOTH)
def export(path: Path, run: Path, file_format: str, json: JsonFlag = False) -> None:
    """Print the file."""
    if json:
        console.print_json({"run": str(run), "format": file_format, "file": str(path)})
    else:
        console.print_text(f"written to {path}")

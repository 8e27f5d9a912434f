"""`measure report`: a run as one HTML file."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.options import command
from measure_lab import api


@command(api.report)
def report(written: Path) -> None:
    """Print the file."""
    console.print_text(str(written))

"""`measure simulate`: a recording of a robot that never was."""

from __future__ import annotations

from pathlib import Path

from measure.cli import console
from measure.cli.options import command
from measure_learning import api


@command(api.simulate_recording, "rendering", "pictures", arguments=0)
def simulate(_: None, out: Path) -> None:
    """Print where the recording is."""
    console.print_text(f"written to {out}; measure it with: measure run {out} -o RUN")

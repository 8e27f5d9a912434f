"""`measure view`: a run in the Rerun viewer."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from measure.cli import console


def view(run: Path, /, *, web: bool = False, bind: str = "127.0.0.1") -> None:
    """Show a run in the viewer.

    Args:
        run: the run's folder, or an .rrd file.
        web: serve the viewer for a browser and print the address, instead of opening a window.
        bind: address to listen on; other machines can look only if you change it.
    """
    from measure.viewing.viewer import open_viewer

    recording = run / "run.rrd" if run.is_dir() else run
    # Ended by a service manager or a closed terminal, the viewer must end too.
    for ending in (signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        signal.signal(ending, lambda number, _: sys.exit(128 + number))
    viewer = open_viewer([recording], web, bind)
    if viewer.address is not None:
        console.print_text(viewer.address)
    try:
        viewer.process.wait()
    finally:
        viewer.process.terminate()

"""Watching a measurement while it runs."""

from __future__ import annotations


def spawn_viewer() -> str:
    """Open the viewer's window; it stays when the measurement is done.

    Returns:
        The address to send a recording to.

    Raises:
        RunError: the viewer is not installed.
    """
    from measure.viewing.viewer import open_viewer

    return open_viewer([]).listens

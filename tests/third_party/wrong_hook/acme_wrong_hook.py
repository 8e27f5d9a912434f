"""A hook that asks for an argument it is not given."""

from __future__ import annotations

from measure.host import hookimpl


@hookimpl
def measure_detectors(config):
    """Expect a configuration."""
    return []

"""Counts filled up to whole vectors of the machine, for loops that leave none to do one by one."""

from __future__ import annotations

from measure.compiling import inlined

DOUBLES, SINGLES = 8, 16
"""How many numbers the longest of its vectors hold."""


@inlined
def whole_vectors(count: int, lanes: int) -> int:
    """The least multiple of `lanes` that is no less than `count`."""
    return -(-count // lanes) * lanes

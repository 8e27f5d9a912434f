"""When something was, on the viewer's timeline."""

from __future__ import annotations

import rerun as rr

from measure.arrays import Floats
from measure.viewing import entities

_SINCE_1970_S = 1e9
"""Times from here on count from 1970 (2001 and later): the viewer shows their date and time."""


def time_column(times_s: Floats) -> rr.TimeColumn:
    """Times (n,) of many rows: as dates where they are, else as times since the start."""
    if len(times_s) and times_s[0] >= _SINCE_1970_S:
        return rr.TimeColumn(entities.TIMELINE_TIME, timestamp=times_s)
    return rr.TimeColumn(entities.TIMELINE_TIME, duration=times_s)


def set_time(stream: rr.RecordingStream, time_s: float) -> None:
    """The time of what is logged next, likewise."""
    if time_s >= _SINCE_1970_S:
        stream.set_time(entities.TIMELINE_TIME, timestamp=time_s)
    else:
        stream.set_time(entities.TIMELINE_TIME, duration=time_s)

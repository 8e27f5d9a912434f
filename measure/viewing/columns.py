"""Frame sets on Rerun's timelines, sent by the column at a fraction of the cost of single rows."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from itertools import chain
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from measure.arrays import Bools, Floats
from measure.viewing import entities

_SINCE_1970_S = 1e9
"""Times from here on (2001 and later) count from 1970: the viewer shows their date and time."""


class FrameSetBatch:
    """One batch on both timelines; `suffix` ends every entity, see `entities.suffix`."""

    def __init__(
        self, stream: rr.RecordingStream, frames: ArrayLike, times_s: ArrayLike, suffix: str = ""
    ) -> None:
        self._stream, self._suffix = stream, suffix
        self._frames = np.asarray(frames, dtype=np.int64)
        self.times_s = np.asarray(times_s, dtype=np.float64)
        self._index = self._on_timelines(np.ones(len(self._frames), dtype=bool))

    def send(self, entity: str, *columns: Iterable[Any], rows: Bools | None = None) -> None:
        """Send one entity's components, for all frame sets or for some rows (n,) of them."""
        index = self._index if rows is None else self._on_timelines(rows)
        self._stream.send_columns(entity + self._suffix, indexes=index, columns=chain(*columns))

    def scalars(self, entity: str, values: Floats, rows: Bools | None = None) -> None:
        """Send numbers, one a row; NaN leaves a gap in the plot."""
        self.send(entity, rr.Scalars.columns(scalars=values), rows=rows)

    def _on_timelines(self, rows: Bools) -> list[rr.TimeColumn]:
        times_s = self.times_s[rows]
        dated = len(times_s) and times_s[0] >= _SINCE_1970_S
        return [
            rr.TimeColumn(entities.TIMELINE_FRAME, sequence=self._frames[rows]),
            rr.TimeColumn(entities.TIMELINE_TIME, timestamp=times_s)
            if dated
            else rr.TimeColumn(entities.TIMELINE_TIME, duration=times_s),
        ]


def lengths(rows: Iterable[Sized]) -> list[int]:
    """How many instances each row has, as `partition` wants it."""
    return [len(row) for row in rows]


def points(rows: Iterable[Any], width: int) -> Floats:
    """Coordinates (n, width) from any number of arrays of them, possibly none."""
    gathered = list(rows)
    if not gathered:
        return np.zeros((0, width))
    return np.concatenate(gathered, axis=None).reshape(-1, width)


def set_time(stream: rr.RecordingStream, time_s: float) -> None:
    """The time of what is logged next: as a date where it is one, else as time since the start."""
    if time_s >= _SINCE_1970_S:
        stream.set_time(entities.TIMELINE_TIME, timestamp=time_s)
    else:
        stream.set_time(entities.TIMELINE_TIME, duration=time_s)

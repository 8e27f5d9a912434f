"""What the latest seconds of a measurement say of its rig, asked now and then beside it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Executor, Future

import numpy as np

from measure.checking.causes import Cause
from measure.checking.diagnosis import diagnose
from measure.checking.finding import Level
from measure.checking.sightings import evidence_of
from measure.limits import SPREAD_OVER
from measure.measuring.measurement import Measurement
from measure.model import Body, Camera

EVERY_S = 15.0
"""Between two looks, which cost 0.3 s of a core each."""
_WINDOW = 300  # Latest frame sets; some, evenly spread, are looked at


class RigWatch:
    """Causes that two looks in a row have named."""

    def __init__(
        self, body: Body, cameras: Sequence[Camera], pool: Executor, every_s: float = EVERY_S
    ) -> None:
        """Look in a thread of `pool`, so that no measurement waits."""
        self._body, self._cameras, self._pool, self._every_s = body, cameras, pool, every_s
        self._latest = deque[Measurement](maxlen=_WINDOW)
        self._look: Future[list[Cause]] | None = None
        self._due_s: float | None = None
        self._before: list[Cause] = []
        self.causes: tuple[Cause, ...] = ()

    def add(self, measured: Measurement) -> None:
        """Take a measurement, in order of time; start a look if one is due, and read one done."""
        if measured.rig is not None and measured.rig.cameras is not self._cameras:
            # What was seen before is no evidence on where cameras stand now.
            self._cameras, self._before, self.causes = measured.rig.cameras, [], ()
            self._latest.clear()
        self._latest.append(measured)
        if self._look is not None and self._look.done():
            found, self._look = self._look.result(), None
            known = {(cause.cause, cause.of) for cause in self._before}
            self.causes = tuple(c for c in found if (c.cause, c.of) in known)
            self._before = found
        if self._due_s is None or measured.time_s >= self._due_s:
            if self._due_s is not None and self._look is None:
                self._look = self._pool.submit(self._looked, list(self._latest))
            self._due_s = measured.time_s + self._every_s

    def _looked(self, measured: Sequence[Measurement]) -> list[Cause]:
        evidence = evidence_of((), (), measured, self._body, self._cameras, most=SPREAD_OVER)
        try:
            return [c for c in diagnose(evidence).causes if c.level is Level.WRONG]
        except np.linalg.LinAlgError:  # nothing finite was seen: the next look is due soon
            return []

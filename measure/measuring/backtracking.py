"""Frame sets in which the body was not found, waiting for one in which it is.

A search of whole pictures may fail where looking near the right place does not. Once the body is
found, the pictures before are near; a detector and a tracker that can go back may be sent there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from measure.measuring.measurement import Draft, Status
from measure.model import FrameSet

_MOST = 4
"""So many frame sets wait with their pictures in memory."""


class Looked(NamedTuple):
    """Pictures, and what was made of them.

    Attributes:
        frame_set: the pictures.
        draft: what they show.
        doubt: a flag for any pose from these pictures; empty if there is nothing to doubt.
    """

    frame_set: FrameSet
    draft: Draft
    doubt: str

    def or_better(self, again: Draft) -> Draft:
        """The draft, or another of the same pictures: any pose for none, a believed one for any."""
        before, after = self.draft.measurement, again.measurement
        if before.status is not Status.LOST and after.status is not Status.OK:
            return self.draft
        again = replace(again, measurement=replace(after, searched=before.searched))
        return again.doubted(self.doubt) if self.doubt else again


def looked_back(
    looked: Iterable[Looked], go_back: Callable[[Sequence[Looked]], Sequence[Draft]]
) -> Iterator[Draft]:
    """Drafts in order; those that wait come as `go_back` returns them, once a pose is believed.

    Args:
        looked: at every frame set, in order of time.
        go_back: called right after a pose is believed, with what waits, in order of time.
    """
    waiting: deque[Looked] = deque()
    for one in looked:
        if one.draft.measurement.status is Status.OK:
            yield from go_back(waiting) if waiting else ()
            waiting.clear()
            yield one.draft
        elif waiting or _not_found(one.draft):
            waiting.append(one)
            if len(waiting) > _MOST:
                yield waiting.popleft().draft
        else:
            yield one.draft
    yield from (one.draft for one in waiting)


def _not_found(draft: Draft) -> bool:
    """Whether there is no pose, or one from a search that is not believed."""
    measured = draft.measurement
    return measured.status is Status.LOST or bool(measured.searched)

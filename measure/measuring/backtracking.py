"""Backtracking: frame sets without a pose wait for the next accepted one and are tracked from it.

A search of whole images may fail where measuring in a predicted window succeeds, and once the body
is found its motion predicts windows in the frame sets before.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from measure.measuring.measurement import Draft, Status
from measure.model import FrameSet

MAX_WAITING = 4  # Frame sets that wait with their images in memory


class ProcessedFrameSet(NamedTuple):
    """Images and what was measured in them."""

    frame_set: FrameSet
    draft: Draft
    flag: str  # a flag for every pose from these images; empty if there is none

    def or_better(self, again: Draft) -> Draft:
        """The draft, or `again` of the same images if it has a pose for none or an accepted one."""
        before, after = self.draft.measurement, again.measurement
        if before.status is not Status.LOST and after.status is not Status.OK:
            return self.draft
        again = replace(again, measurement=replace(after, searched=before.searched))
        return again.flagged(self.flag) if self.flag else again


def backtracked(
    processed: Iterable[ProcessedFrameSet],
    backtrack: Callable[[Sequence[ProcessedFrameSet]], Sequence[Draft]],
) -> Iterator[Draft]:
    """Drafts in order; those without an accepted pose as `backtrack` returns them.

    Args:
        processed: every frame set, in order of time.
        backtrack: called right after an accepted pose with the waiting frame sets, in order of
            time.
    """
    waiting: deque[ProcessedFrameSet] = deque()
    for one in processed:
        if one.draft.measurement.status is Status.OK:
            yield from backtrack(waiting) if waiting else ()
            waiting.clear()
            yield one.draft
        elif waiting or _not_found(one.draft):
            waiting.append(one)
            if len(waiting) > MAX_WAITING:
                yield waiting.popleft().draft
        else:
            yield one.draft
    yield from (one.draft for one in waiting)


def _not_found(draft: Draft) -> bool:
    """Whether there is no pose, or a flagged one from a search."""
    measured = draft.measurement
    return measured.status is Status.LOST or bool(measured.searched)

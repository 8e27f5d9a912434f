"""Before a recording is measured: its first frame sets, for what detectors learn from them alone.

What a camera does to light is learnt from pictures of the balls. The first frame sets would be
measured before that, and with cameras far from the standard be lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace

from measure.errors import MeasureError
from measure.host import Detector
from measure.measuring.pipeline import Pipeline
from measure.measuring.stages import Stages
from measure.model import Body, Camera, FrameSet

_FOUND = 16
"""In so many frame sets with the body every camera has seen a ball often enough, if ever."""
_LONGEST = 64
"""So many frame sets are waited for the body: two seconds of most recordings."""


def wanted(detectors: Mapping[str, Detector]) -> bool:
    """Whether any of the detectors, one per camera, would rather see more pictures first."""
    return any(d.out_of_order and d.wants_rehearsal for d in detectors.values())


def rehearse_if_wanted(
    body: Body,
    cameras: Sequence[Camera],
    detectors: Mapping[str, Detector],
    fresh: Callable[[], Stages],
    frame_sets: Iterable[FrameSet],
) -> None:
    """Let detectors, one per camera, see how a recording begins, if any of them asks for it.

    Args:
        body: what is measured.
        cameras: calibrated.
        detectors: those that will measure the recording.
        fresh: builds stages of which all but the detectors are used, and are of no use after.
        frame_sets: of the recording, from its start.
    """
    if wanted(detectors):
        rehearse(body, cameras, replace(fresh(), detectors=detectors), frame_sets)


def rehearse(
    body: Body, cameras: Sequence[Camera], stages: Stages, frame_sets: Iterable[FrameSet]
) -> None:
    """Measure frame sets until the detectors have learnt, and let them compare what.

    What is wrong with the frame sets shows when they are measured again.

    Args:
        body: what is measured.
        cameras: calibrated.
        stages: the detectors that are to learn; tracker, triangulator and solver, which have seen
            a recording begin after this, are of no use any more.
        frame_sets: of the recording, from its start.
    """
    rehearsal, found = Pipeline(body, cameras, replace(stages, neighbours=False)), 0
    with suppress(MeasureError), closing(rehearsal.measure(frame_sets)) as measured:
        for seen, one in enumerate(measured, 1):
            found += one.pose is not None
            if seen == _LONGEST or found == _FOUND or not wanted(stages.detectors):
                break
    learnt = [detector.learnt for detector in stages.detectors.values()]
    for detector in stages.detectors.values():
        detector.confer(learnt)

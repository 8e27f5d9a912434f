"""Burn-in: the first frame sets of a recording, measured only to calibrate the detectors.

A detector estimates its camera's response curve and blur from images of the balls. Without a
burn-in the first frame sets would be measured before that, or lost where a camera is far from
the standard response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace

from measure.errors import MeasureError
from measure.host import Detector, SelfCalibratingDetector
from measure.measuring.pipeline import Pipeline
from measure.measuring.stages import Stages
from measure.model import Body, Camera, FrameSet

_FRAME_SETS_WITH_BODY = 16
"""After so many with a pose every camera has seen a ball often enough, if it ever will."""
_MAX_FRAME_SETS = 64
"""Two seconds of most recordings."""


def needed(detectors: Mapping[str, Detector]) -> bool:
    """Whether any of the detectors, one per camera, needs more images first."""
    return any(one.needs_burn_in and not one.stateful for one in _learners(detectors))


def _learners(detectors: Mapping[str, Detector]) -> list[SelfCalibratingDetector]:
    return [one for one in detectors.values() if isinstance(one, SelfCalibratingDetector)]


def burn_in_if_needed(
    body: Body,
    cameras: Sequence[Camera],
    detectors: Mapping[str, Detector],
    fresh: Callable[[], Stages],
    frame_sets: Iterable[FrameSet],
) -> None:
    """Show detectors, one per camera, the start of a recording, if any of them needs that.

    Args:
        body: what is measured.
        cameras: calibrated.
        detectors: those that will measure the recording.
        fresh: builds stages of which all but the detectors are used, and are of no use after.
        frame_sets: of the recording, from its start.
    """
    if needed(detectors):
        burn_in(body, cameras, replace(fresh(), detectors=detectors), frame_sets)


def burn_in(
    body: Body, cameras: Sequence[Camera], stages: Stages, frame_sets: Iterable[FrameSet]
) -> None:
    """Measure frame sets until the detectors are calibrated, then combine their estimates.

    Errors of the frame sets are left for when they are measured again.

    Args:
        body: what is measured.
        cameras: calibrated.
        stages: the detectors that are to learn; tracker, triangulator and solver, which have seen
            a recording begin after this, are of no use any more.
        frame_sets: of the recording, from its start.
    """
    pipeline, found = Pipeline(body, cameras, replace(stages, smoothing=False)), 0
    with suppress(MeasureError), closing(pipeline.measure(frame_sets)) as measured:
        for seen, one in enumerate(measured, 1):
            found += one.pose is not None
            if seen == _MAX_FRAME_SETS or found == _FRAME_SETS_WITH_BODY:
                break
            if not needed(stages.detectors):
                break
    learners = _learners(stages.detectors)
    states = [learner.calibration_state for learner in learners]
    for learner in learners:
        learner.fuse_calibration(states)


def enter_realtime(detectors: Mapping[str, Detector]) -> None:
    """Let detectors, one per camera, do slow work in the background from now on."""
    for one in _learners(detectors):
        one.enter_realtime()

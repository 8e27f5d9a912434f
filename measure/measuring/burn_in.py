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
from measure.measuring.pipeline import Pipeline, Stages
from measure.model import Body, Camera, FrameSet

_FRAME_SETS_WITH_BODY = 16
"""Frame sets with a pose after which every camera has seen enough balls, if it ever will."""
_MAX_FRAME_SETS = 64
"""Two seconds of most recordings."""


def needed(detectors: Mapping[str, Detector]) -> bool:
    """Whether any of the detectors, one per camera, needs more images first."""
    return any(one.needs_burn_in and not one.stateful for one in _self_calibrating(detectors))


def _self_calibrating(detectors: Mapping[str, Detector]) -> list[SelfCalibratingDetector]:
    return [one for one in detectors.values() if isinstance(one, SelfCalibratingDetector)]


def burn_in_if_needed(
    body: Body,
    cameras: Sequence[Camera],
    detectors: Mapping[str, Detector],
    new_stages: Callable[[], Stages],
    frame_sets: Iterable[FrameSet],
) -> None:
    """Measure the start of a recording with detectors, one per camera, if any needs a burn-in.

    Args:
        body: what is measured.
        cameras: calibrated.
        detectors: those that will measure the recording.
        new_stages: builds stages of which all but the detectors are used; discarded afterwards.
        frame_sets: of the recording, from its start.
    """
    if needed(detectors):
        burn_in(body, cameras, replace(new_stages(), detectors=detectors), frame_sets)


def burn_in(
    body: Body, cameras: Sequence[Camera], stages: Stages, frame_sets: Iterable[FrameSet]
) -> None:
    """Measure frame sets until the detectors are calibrated, then combine their estimates.

    Errors of the frame sets are ignored here: they recur when the recording is measured.

    Args:
        body: what is measured.
        cameras: calibrated.
        stages: with the detectors to calibrate; its tracker is left in the state of the last frame
            set and must not be used again.
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
    calibrating = _self_calibrating(stages.detectors)
    states = [detector.calibration_state for detector in calibrating]
    for detector in calibrating:
        detector.fuse_calibration(states)


def enter_realtime(detectors: Mapping[str, Detector]) -> None:
    """Let detectors, one per camera, do slow work in the background from now on."""
    for one in _self_calibrating(detectors):
        one.enter_realtime()

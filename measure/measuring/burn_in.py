"""Burn-in: the first frame sets of a recording, measured only to calibrate the detectors.

A detector estimates its camera's response curve and blur from images of the balls. Without a
burn-in the first frame sets would be measured before that, or lost where a camera is far from
the standard response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from itertools import islice

from measure.errors import MeasureError
from measure.estimation.lateral_color import with_lateral_color
from measure.host import Detector, SelfCalibratingDetector
from measure.measuring import body_size
from measure.measuring.measurement import Measurement
from measure.measuring.pipeline import Pipeline
from measure.model import Body, Camera, FrameSet

_FRAME_SETS_WITH_BODY = 16
"""Frame sets with a pose after which every camera has seen enough balls, if it ever will."""
_MAX_FRAME_SETS = 64  # Two seconds of most recordings
_FRAME_SETS_FOR_RADII = 8
"""Detectors know their images from the burn-in, and learn nothing new from them."""

FrameSets = Callable[[], Iterable[FrameSet]]


def needed(detectors: Mapping[str, Detector]) -> bool:
    """Whether any of the detectors, one per camera, needs more images first."""
    return any(one.needs_burn_in and not one.stateful for one in _self_calibrating(detectors))


def _self_calibrating(detectors: Mapping[str, Detector]) -> list[SelfCalibratingDetector]:
    return [one for one in detectors.values() if isinstance(one, SelfCalibratingDetector)]


def calibrated(
    pipeline: Pipeline, build: Callable[[Body, Sequence[Camera]], Pipeline], frame_sets: FrameSets
) -> Pipeline:
    """A pipeline whose detectors have calibrated themselves, if any of them needs a burn-in.

    Where the solver fits outlines, the lateral colour of the cameras is looked for before, and then
    the outlines are compared with the balls' radii: the result is a pipeline for cameras and a body
    with what is known of these. See `lateral_color` and `body_size`.

    Args:
        pipeline: of detectors as they were built.
        build: a pipeline like it for a body and cameras; of parts of its own.
        frame_sets: of the recording, from its start, at every call.
    """
    if not needed(pipeline.stages.detectors):
        return pipeline
    if not pipeline.stages.solver.requires_outlines:
        burn_in(
            _with(build(pipeline.body, pipeline.cameras), pipeline.stages.detectors), frame_sets()
        )
        return pipeline
    cameras = pipeline.cameras
    with suppress(MeasureError):
        cameras = with_lateral_color(cameras, frame_sets())
    given, known = pipeline.body, dict[Body, Mapping[str, Detector]]()
    looked = list[Pipeline]()

    def detectors_for(body: Body) -> Mapping[str, Detector]:
        fresh = build(body, cameras)
        burn_in(_with(fresh, fresh.stages.detectors), frame_sets())
        return fresh.stages.detectors

    def growth(body: Body) -> body_size.OutlineGrowth:
        known[body] = detectors_for(body)
        again = islice(frame_sets(), _FRAME_SETS_FOR_RADII)
        looked.append(_with(build(body, cameras), known[body]))
        measured = _measured(looked[-1], again)
        return body_size.outline_growth(body_size.seen_balls(measured), body, cameras)

    body, contradict = body_size.with_estimated_radii(given, growth)
    detectors = detectors_for(body) if contradict else known[given]
    final = _with(build(body, cameras), detectors, pipeline.stages.smoothing)
    final.judge_pictures_as(looked[-1])
    return final


def _with(
    pipeline: Pipeline, detectors: Mapping[str, Detector], smoothing: bool = False
) -> Pipeline:
    """The same with other detectors."""
    stages = replace(pipeline.stages, detectors=detectors, smoothing=smoothing)
    return Pipeline(pipeline.body, pipeline.cameras, stages)


def _measured(pipeline: Pipeline, frame_sets: Iterable[FrameSet]) -> Iterator[Measurement]:
    """What can be measured: errors recur when the recording is."""
    with suppress(MeasureError), closing(pipeline.measure(frame_sets)) as measured:
        yield from measured


def burn_in(pipeline: Pipeline, frame_sets: Iterable[FrameSet]) -> None:
    """Measure frame sets until the detectors are calibrated, then combine their estimates.

    Errors of the frame sets are ignored here: they recur when the recording is measured.

    Args:
        pipeline: with the detectors to calibrate; its tracker is left in the state of the last
            frame set and must not be used again.
        frame_sets: of the recording, from its start.
    """
    detectors, found = pipeline.stages.detectors, 0
    for seen, one in enumerate(_measured(pipeline, frame_sets), 1):
        found += one.pose is not None
        if seen == _MAX_FRAME_SETS or found == _FRAME_SETS_WITH_BODY:
            break
        if not needed(detectors):
            break
    calibrating = _self_calibrating(detectors)
    states = [detector.calibration_state for detector in calibrating]
    for detector in calibrating:
        detector.fuse_calibration(states)


def enter_realtime(detectors: Mapping[str, Detector]) -> None:
    """Let detectors, one per camera, do slow work in the background from now on."""
    for one in _self_calibrating(detectors):
        one.enter_realtime()

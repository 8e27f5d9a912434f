"""Measuring an opened session, one frame set after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from measure.api.warming_up import warm_pipeline
from measure.host import Registry
from measure.measuring import Measurement, Pipeline, Profile
from measure.model import Body, Camera, FrameSet
from measure.session import Session


def measure_session(
    session: Session, profile: Profile, registry: Registry
) -> Iterator[tuple[FrameSet, Measurement]]:
    """Measure a session's frame sets in order, after a burn-in if detectors calibrate themselves.

    Args:
        session: an open session.
        profile: the stages and their settings.
        registry: where the plugins come from.

    Yields:
        Each frame set with its measurement, as soon as that is final.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
        SessionError: an image that cannot be read.
    """
    pipeline = calibrated_pipeline(session, profile, registry)
    yield from measure_frame_sets(pipeline, session.frame_sets())


def measure_frame_sets(
    pipeline: Pipeline, frame_sets: Iterable[FrameSet]
) -> Iterator[tuple[FrameSet, Measurement]]:
    """Each frame set with its measurement, as soon as that is final; in order of time."""
    waiting: deque[FrameSet] = deque()

    def remember() -> Iterator[FrameSet]:
        for frame_set in frame_sets:
            waiting.append(frame_set)
            yield frame_set

    for measured in pipeline.measure(remember()):
        yield waiting.popleft(), measured


def calibrated_pipeline(session: Session, profile: Profile, registry: Registry) -> Pipeline:
    """A warm pipeline whose detectors have calibrated themselves on the start of the recording.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
        SessionError: no two cameras have images close enough in time.
    """
    body, cameras = session.body, session.cameras
    pipeline = warm_pipeline(profile, registry, body, cameras)
    burn_in(pipeline, profile, registry, body, cameras, session.frame_sets())
    return pipeline


def burn_in(
    pipeline: Pipeline,
    profile: Profile,
    registry: Registry,
    body: Body,
    cameras: Sequence[Camera],
    frame_sets: Iterable[FrameSet],
) -> None:
    """Let a pipeline's detectors calibrate themselves, if any of them needs a burn-in.

    Args:
        pipeline: built from the four that follow.
        profile: the stages and their settings.
        registry: where the plugins come from.
        body: what is measured.
        cameras: calibrated.
        frame_sets: the first ones.
    """
    from measure.api.profiles import build_pipeline
    from measure.measuring.burn_in import burn_in_if_needed

    burn_in_if_needed(
        body,
        cameras,
        pipeline.stages.detectors,
        lambda: build_pipeline(profile, registry, body, cameras).stages,
        frame_sets,
    )

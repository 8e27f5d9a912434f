"""Measuring an opened session, one frame set after the other."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from measure.host import Registry
from measure.measuring import Measurement, Pipeline, Profile, rehearsal
from measure.model import Body, Camera, FrameSet
from measure.session import Session

PATIENCE_S = 2.0
"""A warm-up that takes longer than this is explained."""
AGAIN_S = 8.0
"""So long after the last word comes the next one."""

_log = logging.getLogger(__name__)


def measure_session(
    session: Session, profile: Profile, registry: Registry, start: int = 0
) -> Iterator[tuple[FrameSet, Measurement]]:
    """Measure a session's frame sets in order, after a rehearsal with the first if detectors learn.

    Args:
        session: an open session.
        profile: the stages and their settings.
        registry: where the plugins come from.
        start: index of the first frame set to measure; a rehearsal is always with the very first.

    Yields:
        Each frame set with its measurement, as soon as that is final.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
        SessionError: an image that cannot be read.
    """
    pipeline = rehearsed_pipeline(session, profile, registry)
    waiting: deque[FrameSet] = deque()

    def remember(frame_sets: Iterable[FrameSet]) -> Iterator[FrameSet]:
        for frame_set in frame_sets:
            waiting.append(frame_set)
            yield frame_set

    for measured in pipeline.measure(remember(session.frame_sets(start=start))):
        yield waiting.popleft(), measured


def rehearsed_pipeline(session: Session, profile: Profile, registry: Registry) -> Pipeline:
    """A warm pipeline whose detectors know how the recording begins, if they learn from pictures.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
        SessionError: no two cameras have images close enough in time.
    """
    from measure.api.profiles import build_pipeline

    body, cameras = session.body, session.cameras
    pipeline = warm_pipeline(profile, registry, body, cameras)
    rehearsal.rehearse_if_wanted(
        body,
        cameras,
        pipeline.stages.detectors,
        lambda: build_pipeline(profile, registry, body, cameras).stages,
        session.frame_sets(),
    )
    return pipeline


def warm_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """Build the stages of a profile and let them compile what is slow, with a word to the user.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
    """
    from measure.api.profiles import build_pipeline

    pipeline = build_pipeline(profile, registry, body, cameras)
    with a_word_if_it_takes_long():
        pipeline.warm_up()
    return pipeline


@contextmanager
def a_word_if_it_takes_long() -> Iterator[Callable[[], None]]:
    """Tell the user why nothing seems to happen, but only if it is that something compiles.

    Yields:
        A function to call once something has.
    """
    from numba.core import event

    over, compiled = threading.Event(), event.RecordingListener()
    told = threading.Thread(target=_tell_until, args=(over, compiled.buffer), daemon=True)
    with event.install_listener("numba:compile", compiled):
        told.start()
        try:
            yield over.set
        finally:
            over.set()


def _tell_until(over: threading.Event, compiled: Sequence[object]) -> None:
    """What is loaded from disk is no event; a word about it would be wrong."""
    begun = time.monotonic()
    while not compiled:
        if over.wait(PATIENCE_S):
            return
    _log.warning("compiling the hot loops: once after an installation, two to five minutes")
    while not over.wait(AGAIN_S):
        _log.warning("compiling the hot loops: %.0f s so far", time.monotonic() - begun)

"""What is slow before the first frame: hot loops are compiled, once after an installation."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from measure.host import Registry
from measure.measuring import Pipeline, Profile
from measure.model import Body, Camera

PATIENCE_S = 2.0
"""A warm-up that takes longer than this is explained."""
AGAIN_S = 8.0
"""So long after the last word comes the next one."""

_log = logging.getLogger(__name__)


def warm_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """Build the stages of a profile and let them compile what is slow, with a word to the user.

    Raises:
        PluginError: a plugin that is unknown, broken or ambiguous, or refuses the body.
        ConfigError: settings that do not fit.
    """
    with a_word_if_it_takes_long():
        return compiled_pipeline(profile, registry, body, cameras)


def compiled_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """`warm_pipeline` without a word; a second process compiles what follows detection."""
    from measure.api.compiling_aside import what_follows_aside
    from measure.api.profiles import build_pipeline

    pipeline = build_pipeline(profile, registry, body, cameras)
    with what_follows_aside(profile, registry, body, cameras):
        pipeline.warm_up_detectors()
    pipeline.warm_up_what_follows()
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

"""Compilation before the first frame, once after an installation."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from measure.api.profiles import build_pipeline
from measure.compiling import is_kept_for_now, share_compiled
from measure.host import Registry
from measure.measuring import Pipeline, Profile
from measure.model import Body, Camera

PATIENCE_S = 2.0
"""Compilation that takes longer than this is reported."""
AGAIN_S = 8.0
"""Time between two notices."""

_log = logging.getLogger(__name__)


def warm_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """`build_pipeline`, and compile its stages, with a notice where that takes long."""
    with compilation_notice():
        return compile_pipeline(profile, registry, body, cameras)


def compile_pipeline(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Pipeline:
    """`warm_pipeline` without the notice; a second process begins with the last stages."""
    from measure.api.second_compiler import second_compiler

    pipeline = build_pipeline(profile, registry, body, cameras)
    with second_compiler(profile, registry, body, cameras):
        pipeline.warm_up()
    return pipeline


@contextmanager
def compilation_notice() -> Iterator[Callable[[], None]]:
    """Log a notice while this block compiles, if that takes long; yields what ends the notices."""
    from numba.core import event

    over, compiled = threading.Event(), event.RecordingListener()
    notifier = threading.Thread(target=_notify, args=(over, compiled.buffer), daemon=True)
    with event.install_listener("numba:compile", compiled):
        notifier.start()
        try:
            yield over.set
        finally:
            over.set()


def _notify(over: threading.Event, compiled: Sequence[object]) -> None:
    begun_s, begun = time.time(), time.monotonic()
    while not compiled:
        if over.wait(PATIENCE_S):
            return
    often = (
        "each time, for no folder can be written: fill the installation with `measure prepare`"
        if is_kept_for_now()
        else "once after an installation"
    )
    _log.warning("compiling the numerical code: %s, two minutes on free cores", often)
    while not over.wait(AGAIN_S):
        share, taken_s = share_compiled(begun_s), time.monotonic() - begun
        left = f", about {taken_s * (1 / share - 1):.0f} s left" if share else ""
        _log.warning("compiling the numerical code: %.0f %% done%s", 100 * share, left)

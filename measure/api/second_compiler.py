"""A second process compiles the later stages while this one compiles the detectors."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from numba.core import event

from measure.api.profiles import build_pipeline
from measure.host import Registry
from measure.measuring import Profile
from measure.model import Body, Camera
from measure.processes import usable_cores


@contextmanager
def second_compiler(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Iterator[None]:
    """Compile all stages but the detectors in a second process, which fills the cache on disk.

    It starts when numba first compiles inside the block, so never where the cache is complete.
    """
    process, failed = SecondCompiler((profile, registry, body, cameras)), True
    try:
        with event.install_listener("numba:compile", process):
            yield
        failed = False
    finally:
        process.end(at_once=failed)


class SecondCompiler(event.Listener):  # type: ignore[misc]
    """Starts the process at numba's first compilation, and ends it.

    None is started on a single core, in a frozen program (which is no interpreter), or with plugins
    that cannot be pickled. One that hangs, say on a device that this process holds, is killed: only
    time is lost.

    Attributes:
        process: the running or ended process; None if none was started.
    """

    def __init__(self, work: tuple[object, ...]) -> None:
        alone = usable_cores() == 1 or getattr(sys, "frozen", False)
        self._work: tuple[object, ...] | None = None if alone else work
        self.process: subprocess.Popen[bytes] | None = None
        self._begun_s = time.monotonic()

    def on_start(self, event: object) -> None:  # noqa: ARG002
        """Called by numba when it begins to compile a function."""
        work, self._work = self._work, None
        if work is None:
            return
        with suppress(OSError, pickle.PicklingError, TypeError, AttributeError):
            pickled = pickle.dumps(work)
            self.process = subprocess.Popen(
                [sys.executable, "-c", f"from {__name__} import _compile; _compile()"],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            assert self.process.stdin is not None
            with self.process.stdin as pipe:
                pipe.write(pickled)

    def on_end(self, event: object) -> None:
        """Called by numba after each function."""

    def end(self, at_once: bool) -> None:
        """Kill the process, after waiting as long as the detectors took unless `at_once`."""
        if self.process is None:
            return
        try:
            self.process.wait(0.0 if at_once else time.monotonic() - self._begun_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _compile() -> None:
    build_pipeline(*pickle.load(sys.stdin.buffer)).warm_up_what_follows()

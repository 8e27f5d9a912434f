"""A second process that compiles into the cache on disk: what follows detection, then its end."""

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
def what_follows_aside(
    profile: Profile, registry: Registry, body: Body, cameras: Sequence[Camera]
) -> Iterator[None]:
    """Have a pipeline's later stages compiled while detectors are, if those have to be.

    What another process has compiled only has to be loaded.
    """
    aside, at_once = _SecondProcess((profile, registry, body, cameras)), True
    try:
        with event.install_listener("numba:compile", aside):
            yield
        at_once = False
    finally:
        aside.end(at_once)


class _SecondProcess(event.Listener):  # type: ignore[misc]
    """Begins as soon as something is compiled, for then all is; what it compiles is on disk.

    Where there is one core only, or what it takes cannot be handed over, there is no such process;
    nor in a frozen program, which is no interpreter to start. Where it hangs (a part that waits for
    a device which this process holds) it is given up. Nothing is lost but time.
    """

    def __init__(self, work: tuple[object, ...]) -> None:
        alone = usable_cores() == 1 or getattr(sys, "frozen", False)
        self._work: tuple[object, ...] | None = None if alone else work
        self._process: subprocess.Popen[bytes] | None = None
        self._begun_s = time.monotonic()

    def on_start(self, event: object) -> None:  # noqa: ARG002
        """Called by numba when it begins to compile a function."""
        work, self._work = self._work, None
        if work is None:
            return
        with suppress(OSError, pickle.PicklingError, TypeError, AttributeError):
            handed_over = pickle.dumps(work)
            self._process = subprocess.Popen(
                [sys.executable, "-c", f"from {__name__} import _compile; _compile()"],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            assert self._process.stdin is not None
            with self._process.stdin as pipe:
                pipe.write(handed_over)

    def on_end(self, event: object) -> None:
        """Nothing to do: it goes on with its own."""

    def end(self, at_once: bool) -> None:
        """Stop it, or wait as long again as detectors took: it has less to do than they."""
        if self._process is None:
            return
        patience_s = 0.0 if at_once else time.monotonic() - self._begun_s
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _compile() -> None:
    """What the second process does."""
    build_pipeline(*pickle.load(sys.stdin.buffer)).warm_up_what_follows()

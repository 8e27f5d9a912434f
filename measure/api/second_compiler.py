"""A second process compiles the same from the other end: what it has done is only loaded here."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
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
    """Compile the last stages first in a second process, which fills the cache on disk.

    It starts when numba first compiles inside the block, so never where the cache is complete.
    """
    process = SecondCompiler((profile, registry, body, cameras))
    try:
        with event.install_listener("numba:compile", process):
            yield
    finally:
        process.end()


class SecondCompiler(event.Listener):  # type: ignore[misc]
    """Starts the process at numba's first compilation, and ends it.

    None is started on a single core, in a frozen program (which is no interpreter), or with plugins
    that cannot be pickled.

    Attributes:
        process: the running or ended process; None if none was started.
    """

    def __init__(self, work: tuple[object, ...]) -> None:
        alone = usable_cores() == 1 or getattr(sys, "frozen", False)
        self._work: tuple[object, ...] | None = None if alone else work
        self.process: subprocess.Popen[bytes] | None = None

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

    def end(self) -> None:
        """Kill the process: what it still compiles is there by now, or is not needed."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def _compile() -> None:
    build_pipeline(*pickle.load(sys.stdin.buffer)).warm_up(backwards=True)

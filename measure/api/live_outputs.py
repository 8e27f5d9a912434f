"""Where live measurements go."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from measure.api.recording import CaptureRequest
from measure.api.run_log import LogOptions, RunLog
from measure.measuring import Measurement
from measure.model import Body, Camera, FrameSet
from measure.results import PoseSender, Provenance, RunWriter, Summary


@dataclass(frozen=True)
class LiveOptions(LogOptions):
    """How cameras are measured live, beside the run's recording.

    Attributes:
        record: a session folder to record the pictures into as well.
        send: host and port that every pose is sent to by UDP.
        seconds: how long; until interrupted if None.
        request: what cameras of this machine are set to.
        overwrite: throw an earlier run away.
    """

    record: Path | None = None
    send: tuple[str, int] | None = None
    seconds: float | None = None
    request: CaptureRequest | None = None
    overwrite: bool = False


class LiveOutputs:
    """The run's folder, its recording, and the receiver of poses; all end with `stack`."""

    def __init__(
        self,
        stack: ExitStack,
        out: Path,
        made_from: Provenance,
        body: Body,
        cameras: Sequence[Camera],
        options: LiveOptions,
    ) -> None:
        self._sender = self._log = None
        if options.send is not None:
            self._sender = stack.enter_context(PoseSender(options.send))
        self._writer = stack.enter_context(
            RunWriter(out, made_from, body, cameras, overwrite=options.overwrite)
        )
        self._writer.begin()
        if options.recording or options.viewer:
            self._log = stack.enter_context(RunLog(out.resolve().name, body, cameras, out, options))

    def add(self, frame_set: FrameSet, measured: Measurement) -> None:
        """Hand a measurement on, to the receiver first."""
        if self._sender is not None:
            self._sender.send(measured)
        self._writer.append(measured)
        if self._log is not None:
            self._log.add(measured, frame_set)

    def finish(self) -> Summary:
        """Finish the run's folder."""
        if self._log is not None:
            self._log.close()
        return self._writer.finish()

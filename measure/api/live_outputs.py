"""Where live measurements go."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from measure.api.recording import Asked
from measure.api.run_log import RunLog
from measure.measuring import Measurement
from measure.model import Body, Camera, FrameSet
from measure.results import PoseSender, Provenance, RunWriter, Summary


@dataclass(frozen=True)
class LiveOptions:
    """How cameras are measured live.

    Attributes:
        record: a session folder to record the pictures into as well.
        send: host and port that every pose is sent to by UDP.
        seconds: how long; until told to stop if None.
        asked: what cameras of this machine are asked for.
        image_every: pictures of every n-th frame set go into `run.rrd`; 0 for none.
        recording: whether to write `run.rrd` at all.
        viewer: address of a running viewer to send to while measuring.
        overwrite: throw an earlier run away.
    """

    record: Path | None = None
    send: tuple[str, int] | None = None
    seconds: float | None = None
    asked: Asked | None = None
    image_every: int = 0
    recording: bool = True
    viewer: str | None = None
    overwrite: bool = False


class LiveOutputs:
    """The run's folder, its recording, and whoever is sent poses; all end with `stack`."""

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
        if options.recording or options.viewer:
            self._log = stack.enter_context(
                RunLog(
                    out.resolve().name,
                    body,
                    cameras,
                    out,
                    recording=options.recording,
                    viewer=options.viewer,
                    image_every=options.image_every,
                )
            )

    def add(self, frame_set: FrameSet, measured: Measurement) -> None:
        """Hand a measurement on: first to whoever waits for it."""
        if self._sender is not None:
            self._sender.send(measured)
        self._writer.append(measured)
        if self._log is not None:
            self._log.add(measured, frame_set)

    def finish(self) -> Summary:
        """Finish the run's folder."""
        return self._writer.finish()

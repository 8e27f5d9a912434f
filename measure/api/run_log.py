"""`run.rrd`, written while a run is measured, and what is sent to a viewer meanwhile."""

# Annotations are no texts here: cyclopts reads them of records that inherit these in other modules.

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from measure.errors import ConfigError, RunError
from measure.measuring import Measurement
from measure.model import Body, Camera, FrameSet
from measure.processes import largest_file_bytes
from measure.results import digest
from measure.results.journal import unfinished
from measure.session import Trajectory

if TYPE_CHECKING:
    from measure.viewing import recording

RESERVED_BYTES = 32_000_000
"""Least room on the disk to go on: more than the recording buffers at a time."""
LEAST_BYTES, BYTES_A_VIEW, BYTES_A_PIXEL = 1_500_000, 4_000, 0.3
"""What a short recording needs: what stands at its head, and its tables; for each ball in each
camera of a frame set (300 sets of four cameras and three balls take 10 MB); and as a picture."""


@dataclass(frozen=True)
class LogOptions:
    """What goes into a run's recording, and to a viewer meanwhile.

    Attributes:
        connect: send to a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
        images: pictures to keep in the viewer's recording: none, all, or those of every N-th set.
        recording: write run.rrd for the viewer.
    """

    connect: str | None = None
    images: str | int = 10
    recording: bool = True

    def __post_init__(self) -> None:
        if not (self.images == "none" or self.image_every > 0):
            raise ConfigError(
                f"--images {self.images}: expected none, all, or a number N for every N-th set"
            )

    @property
    def image_every(self) -> int:
        """Of how many frame sets the pictures of one are kept; 0 for none."""
        text = {"all": "1"}.get(str(self.images), str(self.images))
        return int(text) if text.isdecimal() else 0

    @property
    def wanted(self) -> bool:
        """Whether anything of a run is logged."""
        return self.recording or bool(self.connect)

    def check_viewer(self) -> None:
        """Refuse (ConfigError) an address where no viewer listens, before anything is measured."""
        if self.connect:
            from measure.viewing.recording import check_listening

            check_listening(self.connect)


class RunLog:
    """The recording of a run in its folder, with the error against truth where there is one.

    That of an interrupted run is replaced by this one as soon as this one holds as many frame sets
    as are `kept` of it. Nothing is logged unless `options.wanted`. `note` takes lines about the
    viewer, from any thread. `frame_sets` are to come, where that is known.
    """

    def __init__(
        self,
        name: str,
        bodies: Sequence[Body],
        cameras: Sequence[Camera],
        out: Path,
        options: LogOptions,
        kept: int = 0,
        truths: Mapping[str, Trajectory] | None = None,
        videos: Mapping[str, "recording.PassedVideo"] | None = None,
        note: Callable[[str], None] = print,
        frame_sets: int | None = None,
    ) -> None:
        self._path = out / "run.rrd" if options.recording else None
        self._kept, self._problem = kept, ""
        self._left = None if videos else frame_sets  # which go in whole
        a_set = len(cameras) * sum(len(body.balls) for body in bodies) * BYTES_A_VIEW
        pixels = sum(int(np.prod(camera.intrinsics.size_wh)) for camera in cameras)
        self._bytes_a_set, self._bytes_a_picture = a_set, round(pixels * BYTES_A_PIXEL)
        self._image_every = options.image_every
        self._log: recording.RunRecording | None = None
        if not options.wanted:
            return
        from measure.viewing.recording import RunRecording, open_recording

        self._check_room()
        run_id = digest([(out / "run.toml").read_bytes()])
        file = unfinished(self._path) if self._path and kept else self._path
        stream = open_recording(
            *(name, cameras, file, options.connect, run_id),
            bodies=[body.name for body in bodies],
            truth=bool(truths),
            note=note,
        )
        self._log = RunRecording(
            stream,
            bodies,
            cameras,
            options.image_every,
            videos,
            truths,
            live=options.connect is not None,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close()
        if self._path is not None:
            unfinished(self._path).unlink(missing_ok=True)
        # If the tables met a full disk too, their message is the one to read; if not, they are
        # complete without the recording.
        if self._problem and kind is None:
            raise RunError(
                f"{self._path} could not be written whole "
                f"({self._problem}); the tables of the run are complete"
            )

    def close(self) -> None:
        """Close the recording; a failure is reported at the end of the block."""
        log, self._log = self._log, None
        if log is not None:
            try:
                log.close()
            except RuntimeError as problem:
                # Rerun's writer thread died, most often of a full disk.
                self._problem = str(problem)

    def _check_room(self) -> None:
        """Stop while the tables still fit: Rerun's writer may hang when it cannot write on."""
        if self._path is None:
            return
        needed = RESERVED_BYTES
        if self._left is not None:
            pictured = math.ceil(self._left / self._image_every) if self._image_every else 0
            rest = self._left * self._bytes_a_set + pictured * self._bytes_a_picture
            needed = min(needed, LEAST_BYTES + rest)
        free, largest = shutil.disk_usage(self._path.parent).free, largest_file_bytes()
        if free < needed:
            why = f"the disk is full but for {free // 1000} kB"
        elif largest < needed + max(map(_size, (self._path, unfinished(self._path)))):
            why = f"no file may be larger than {largest // 1000} kB (`ulimit -f`)"
        else:
            return
        raise RunError(
            f"{self._path}: {why}; everything measured before is kept: mend that and go on with "
            "--resume, or leave the recording out with --no-recording"
        )

    def add(self, measurements: Sequence[Measurement], frame_set: FrameSet | None = None) -> None:
        """Log a frame set, its pictures if it is their turn; RunError if the disk is full."""
        if self._log is None:
            return
        self._check_room()
        self._log.add(measurements, frame_set)
        if self._left is not None:
            self._left = max(self._left - 1, 0)
        if self._path is not None and measurements[0].index + 1 == self._kept:
            self._log.flush()
            unfinished(self._path).replace(self._path)


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0

"""A run as a Rerun recording: cameras, pictures, states, rays, balls, pose, uncertainty, traces.

A running viewer gets it from a thread of its own, so that nobody waits for the viewer.
"""

from __future__ import annotations

import math
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from queue import Empty, Queue
from typing import Any, Self
from urllib.parse import urlsplit

import av
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from measure.errors import ConfigError
from measure.limits import PATIENCE_S
from measure.measuring import Measurement, Status
from measure.model import Body, Camera, FrameSet, Image
from measure.session import Session, Trajectory
from measure.session import Stream as CameraStream
from measure.viewing import entities, scene
from measure.viewing.blueprint import framed, run_blueprint
from measure.viewing.entities import FrameSetBatch, Stream, set_time

HELD_BYTES = 64 << 20
"""What waits for a viewer at most: more is not sent to it until it has taken some."""
SLOW_S = 3.0
"""A viewer that takes one message for so long does not keep up; the end waits no longer for it."""
_FLUSH_EVERY_S = 1.0
_POLL_S = 0.05


class ViewerFeed:
    """A recording that is sent to a viewer. If the viewer freezes or goes away, some of it is lost.

    Rerun's calls wait for the viewer without a limit, and nothing interrupts them: a daemon thread
    makes them. The methods are those of `rerun.RecordingStream`.

    Args:
        address: of the viewer, such as `rerun+http://127.0.0.1:9876/proxy`.
        note: called, from any thread, with a line when the viewer does not keep up, when it takes
            everything again, and when it is gone.
        layout: how the viewer shows the recording.
        name: of the recording.
        part_of: recordings of one such name are shown as one.
    """

    def __init__(
        self,
        address: str,
        note: Callable[[str], None],
        layout: rrb.Blueprint,
        name: str = "",
        part_of: str | None = None,
    ) -> None:
        self._who, self._note = f"the viewer at {address}", note
        self._stream = rr.RecordingStream("triball", recording_id=part_of)
        self._waiting = Queue[tuple[int, Callable[[], object]] | None]()
        self._lock, self._held, self._left_out = threading.Lock(), 0, 0
        self._is_slow, self._is_gone, self._busy_since = False, False, math.inf
        # Rerun would wait for the viewer again when Python ends.
        rr.unregister_shutdown()
        sink = rr.GrpcSink(address)
        self._put(lambda: self._stream.set_sinks(sink, default_blueprint=layout))
        if name:
            self._put(lambda: self._stream.send_recording_name(name))
        self._thread = threading.Thread(target=self._work, daemon=True, name=address)
        self._thread.start()

    def log(self, entity: str, /, *what: Any, static: bool = False) -> None:
        """Log what happens at the time that is set, or what holds always."""
        # What holds always is sent once, and is in memory anyway: the rig, and whole videos.
        parts = () if static else chain(*(one.as_component_batches() for one in what))
        self._put(lambda: self._stream.log(entity, *what, static=static), *parts)

    def send_columns(
        self, entity: str, /, indexes: Iterable[Any], columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Send the values of several instants."""
        kept = list(columns)
        batches = (column.component_batch for column in kept)
        self._put(lambda: self._stream.send_columns(entity, indexes, kept), *batches)

    def set_time(self, timeline: str, /, **when: Any) -> None:
        """Set the time of what is logged next."""
        self._put(lambda: self._stream.set_time(timeline, **when))

    def close(self) -> None:
        """Send what waits, unless the viewer does not keep up; an interrupt ends the wait."""
        self._waiting.put(None)
        with suppress(KeyboardInterrupt):
            while self._thread.is_alive() and not self._is_stuck():
                self._thread.join(_POLL_S)
        if self._thread.is_alive():
            self._tell_slow()

    def _put(self, send: Callable[[], object], *parts: rr.ComponentBatchLike) -> None:
        if self._is_gone:
            return
        size = sum(part.as_arrow_array().nbytes for part in parts)
        with self._lock:
            is_full = self._held > 0 and self._held + size > HELD_BYTES
            self._held += 0 if is_full else size
        self._left_out += is_full
        if not is_full:
            self._waiting.put((size, send))
        if is_full or self._is_stuck():
            self._tell_slow()

    def _is_stuck(self) -> bool:
        return time.monotonic() - self._busy_since > SLOW_S

    def _tell_slow(self) -> None:
        if not (self._is_slow or self._is_gone):
            self._is_slow = True
            self._note(f"{self._who} does not keep up: what it does not take is not shown there")

    def _work(self) -> None:
        try:
            flushed_s = time.monotonic()
            while (item := self._next()) is not None:
                size, send = item
                self._call(send)
                with self._lock:
                    self._held -= size
                if time.monotonic() - flushed_s > _FLUSH_EVERY_S:
                    self._flush()
                    flushed_s = time.monotonic()
            self._flush()
            self._call(self._stream.disconnect)
        except RuntimeError:  # the connection is severed
            self._is_gone = True
            self._note(f"{self._who} is gone: the rest is not shown there")

    def _next(self) -> tuple[int, Callable[[], object]] | None:
        """What is to be sent; now and then nothing, for what was sent to be flushed."""
        try:
            return self._waiting.get(timeout=_FLUSH_EVERY_S)
        except Empty:
            return 0, lambda: None

    def _flush(self) -> None:
        """Wait until the viewer has taken all; RuntimeError, which no other call raises: gone."""
        self._call(self._stream.flush)
        if self._is_slow:
            self._is_slow = False
            left_out = f"; {self._left_out} messages were left out" if self._left_out else ""
            self._note(f"{self._who} keeps up again{left_out}")

    def _call(self, send: Callable[[], object]) -> None:
        self._busy_since = time.monotonic()
        send()
        self._busy_since = math.inf


_CODECS = {"h264", "hevc", "av1", "vp9"}
"""What the viewer shows in an mp4. Of other videos the frames go in as pictures."""
LARGEST_BYTES = 500_000_000
"""Larger videos go in as pictures: one message to the viewer holds the whole file."""


@dataclass(frozen=True, eq=False)
class PassedVideo:
    """One camera's video file."""

    asset: rr.AssetVideo
    times_ns: Mapping[int, int]  # by frame number, when a frame is presented


def passed_videos(session: Session) -> Mapping[str, PassedVideo]:
    """By camera name, the videos of a session that the viewer can show."""
    found = {name: _open(stream) for name, stream in session.streams.items()}
    return {name: video for name, video in found.items() if video is not None}


def _open(stream: CameraStream) -> PassedVideo | None:
    path = stream.files[0]
    if len(stream.files) != 1 or path.suffix.lower() not in (".mp4", ".m4v", ".mov"):
        return None
    if path.stat().st_size > LARGEST_BYTES or _codec(path) not in _CODECS:
        return None
    asset = rr.AssetVideo(path=path, media_type="video/mp4")
    try:
        times_ns = asset.read_frame_timestamps_nanos()
    except RuntimeError:
        return None
    if len(times_ns) != len(stream.frames):
        return None
    return PassedVideo(asset, dict(zip(stream.frames.tolist(), map(int, times_ns), strict=True)))


def _codec(path: Path) -> str:
    with av.open(str(path)) as container:
        return str(container.streams.video[0].codec_context.name)


HELD_SETS = 120
"""Frame sets held back at most: sent together they cost a fraction of what each would."""
PERIOD_S, WORTH_SENDING = 2.0, 30
"""So many are not held back longer: what a kill may cost. Fewer at a time would swell the file."""
LIVE_PERIOD_S = 0.2  # Where somebody watches nothing is held back longer, be it only one frame set
_LEVELS = {Status.OK: "INFO", Status.FLAGGED: "WARN", Status.LOST: "ERROR", Status.SKIPPED: "WARN"}


class OpenRecording:
    """A recording that is written as it goes: to a file, to a viewer that runs, or to both.

    Nobody waits for the viewer, and the file does not depend on it.
    """

    def __init__(self, file: rr.RecordingStream | None, viewer: ViewerFeed | None = None) -> None:
        self._file, self._viewer = file, viewer
        self._all: Sequence[Stream] = [one for one in (file, viewer) if one is not None]

    def log(self, entity: str, /, *what: Any, static: bool = False) -> None:
        """As `rerun.RecordingStream.log`."""
        for one in self._all:
            one.log(entity, *what, static=static)

    def send_columns(self, entity: str, /, indexes: Iterable[Any], columns: Iterable[Any]) -> None:
        """As `rerun.RecordingStream.send_columns`."""
        for one in self._all:
            one.send_columns(entity, indexes, columns)

    def set_time(self, timeline: str, /, **when: Any) -> None:
        """As `rerun.RecordingStream.set_time`."""
        for one in self._all:
            one.set_time(timeline, **when)

    def flush(self) -> None:
        """Write the file as far as it has come; RuntimeError: it cannot be written."""
        if self._file is not None:
            self._file.flush(timeout_sec=PATIENCE_S)

    def close(self) -> None:
        """Close the file, then send the viewer what waits for it; RuntimeError as `flush`."""
        try:
            self._close_file()
        finally:
            if self._viewer is not None:
                self._viewer.close()

    def _close_file(self) -> None:
        if self._file is None:
            return
        try:
            self.flush()
        except RuntimeError:
            # Where its writer has died, Rerun waits for it: when it closes, and when Python ends.
            rr.unregister_shutdown()
            threading.Thread(target=self._file.disconnect, daemon=True).start()
            raise
        self._file.disconnect()


class RunRecording:
    """Takes measurements as they come; use it as a context manager.

    Args:
        stream: where they go (see `open_recording`).
        image_every: log the pictures of every n-th frame set; 0 logs none.
        videos: by camera name, recorded videos that go into the recording as they are.
        truths: the true world_from_body by body, where it is known.
        live: whether somebody watches.
    """

    def __init__(
        self,
        stream: OpenRecording,
        bodies: Sequence[Body],
        cameras: Sequence[Camera],
        image_every: int,
        videos: Mapping[str, PassedVideo] | None = None,
        truths: Mapping[str, Trajectory] | None = None,
        live: bool = False,
    ) -> None:
        self._stream = stream
        several = len(bodies) > 1
        self._bodies = [(b, entities.suffix(b.name, several), scene.PosesBefore()) for b in bodies]
        self._cameras = cameras
        self._image_every = image_every
        self._videos = dict(videos or {}) if image_every else {}
        self._truths = truths or {}
        self._live = live
        self._status = dict[str, str]()
        self._sent_at = time.monotonic()
        self._sets: list[Sequence[Measurement]] = []
        self._pictured: list[bool] = []
        self._has_pictures = False  # The first frame set has them, or none
        scene.log_rig(stream, bodies, cameras)
        for name, video in self._videos.items():
            stream.log(entities.image(name), video.asset, static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Send what is held back and close the file; RuntimeError: it cannot be written."""
        self._send()
        self._stream.close()

    def flush(self) -> None:
        """Send what is held back; RuntimeError as `close`."""
        self._send()
        self._stream.flush()

    def add(self, measured: Sequence[Measurement], frame_set: FrameSet | None = None) -> None:
        """Log a measurement of each body, and the images of `frame_set`."""
        index = measured[0].index
        pictured = bool(frame_set and self._image_every and not index % self._image_every)
        if frame_set is not None and pictured:
            self._log_images(measured[0], frame_set)
            self._has_pictures = True
        for one, (_, end, _) in zip(measured, self._bodies, strict=True):
            self._log_status(one, entities.STATUS + end)
        self._sets.append(measured)
        self._pictured.append(pictured)
        if self._due():
            self._send()

    def _due(self) -> bool:
        held, waited_s = len(self._sets), time.monotonic() - self._sent_at
        if self._live:
            return waited_s > LIVE_PERIOD_S
        return held >= HELD_SETS or (held >= WORTH_SENDING and waited_s > PERIOD_S)

    def _send(self) -> None:
        pictured, cameras = np.array(self._pictured), self._cameras
        for number, (body, end, before) in enumerate(self._bodies if self._sets else ()):
            sets = [one[number] for one in self._sets]
            times_s = [one.time_s for one in sets]
            columns = FrameSetBatch(self._stream, [one.index for one in sets], times_s, end)
            scene.send_balls(columns, sets, body, cameras)
            scene.send_poses(columns, sets, body, before)
            scene.send_views(columns, sets, pictured, body, cameras, self._has_pictures)
            scene.send_traces(columns, sets, cameras)
            if body.name in self._truths:
                scene.send_errors(columns, sets, self._truths[body.name])
        self._sets, self._pictured = [], []
        self._sent_at = time.monotonic()

    def _log_status(self, measured: Measurement, entity: str) -> None:
        text = ": ".join(filter(None, (measured.status.value, measured.reason)))
        if text != self._status.get(entity):
            self._set_time(measured)
            self._stream.log(entity, rr.TextLog(text, level=_LEVELS[measured.status]))
            self._status[entity] = text

    def _set_time(self, measured: Measurement) -> None:
        self._stream.set_time(entities.TIMELINE_FRAME, sequence=measured.index)
        set_time(self._stream, measured.time_s)

    def _log_images(self, measured: Measurement, frame_set: FrameSet) -> None:
        self._set_time(measured)
        for name, image in frame_set.images.items():
            shown = scene.picture_of(image)
            if name in self._videos:
                time_ns = self._videos[name].times_ns[image.frame]
                shown = rr.VideoFrameReference(nanoseconds=time_ns)
            self._stream.log(entities.image(name), shown)


class LivePictures:
    """What cameras show, in a viewer that runs: some pictures a second of each.

    Args:
        address: of the viewer; ConfigError if none listens there.
        note: see `ViewerFeed`.
    """

    def __init__(self, cameras: Sequence[str], address: str, note: Callable[[str], None]) -> None:
        check_listening(address)
        views = (rrb.Spatial2DView(origin=entities.image(name), name=name) for name in cameras)
        layout = framed(rrb.Grid(*views, name="Cameras"))
        self._feed, self._lock = ViewerFeed(address, note, layout), threading.Lock()
        self._due_s = dict.fromkeys(cameras, 0.0)

    def add(self, image: Image) -> None:
        """Show a picture, if the camera's last one has been shown for long enough."""
        if image.time_s >= self._due_s[image.camera]:
            self._due_s[image.camera] = image.time_s + LIVE_PERIOD_S
            with self._lock:  # pictures come from the cameras' threads
                set_time(self._feed, image.time_s)
                self._feed.log(entities.image(image.camera), scene.picture_of(image))

    def close(self) -> None:
        """Send what waits for the viewer."""
        self._feed.close()


CONNECT_WITHIN_S = 5.0  # How long a viewer that was just started may take to listen


def open_recording(
    name: str,
    cameras: Sequence[Camera],
    path: Path | None = None,
    address: str | None = None,
    part_of: str | None = None,
    bodies: Sequence[str] = ("",),
    truth: bool = False,
    note: Callable[[str], None] = print,
) -> OpenRecording:
    """A recording that is written as it goes: to a file, to a viewer that runs, or to both.

    The cameras make the layout that travels inside; recordings that are `part_of` one name are
    shown as one. `truth` says whether errors are shown, beside where the body is. `note` takes
    lines about the viewer, see `ViewerFeed`. ConfigError: no viewer listens at the address (as
    `rerun+http://127.0.0.1:9876/proxy`).
    """
    layout, file, viewer = run_blueprint(cameras, bodies, truth), None, None
    if address is not None:
        check_listening(address)
    if path is not None:
        file = rr.RecordingStream("triball", recording_id=part_of)
        file.set_sinks(rr.FileSink(path), default_blueprint=layout)
        file.send_recording_name(name)
    if address is not None:
        viewer = ViewerFeed(address, note, layout, name, part_of)
    return OpenRecording(file, viewer)


def is_whole(path: Path) -> bool:
    """Whether a file is a recording that was closed, and all of it can be read."""
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that it has no end
            reader = RrdReader(path)
            reader.store()  # an error without an end
            return sum(1 for _ in reader.stream()) > 0
    except (OSError, RuntimeError, ValueError):
        return False


def check_listening(address: str) -> None:
    """Refuse (ConfigError) an address where no viewer is: Rerun itself would only log that."""
    host, port = _host_and_port(address)
    deadline = time.monotonic() + CONNECT_WITHIN_S
    while True:
        try:
            socket.create_connection((host, port), timeout=1.0).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise ConfigError(f"no viewer listens at {address}: {error.strerror}") from error
            time.sleep(0.1)


def _host_and_port(address: str) -> tuple[str, int]:
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port or 9876
    except ValueError:
        host = None
    if host is None or not parts.scheme.startswith("rerun"):
        raise ConfigError(
            f"'{address}' is no viewer's address: expected rerun+http://127.0.0.1:9876/proxy"
        )
    return host, port

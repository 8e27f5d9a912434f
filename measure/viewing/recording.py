"""A run as a Rerun recording: cameras, pictures, states, rays, balls, pose, uncertainty, traces."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

import numpy as np
import rerun as rr

from measure.arrays import Floats
from measure.errors import ConfigError
from measure.geometry import RigidTransform
from measure.measuring import Measurement, Status
from measure.model import BallView, Body, Camera, FrameSet, Pose
from measure.viewing import entities
from measure.viewing.blueprint import run_blueprint
from measure.viewing.columns import ColumnLog
from measure.viewing.rig import log_rig
from measure.viewing.videos import PassedVideo

FLUSH_ROWS = 60
CONNECT_WITHIN_S = 5.0
"""How long a viewer that was just started may take to listen."""
_CIRCLE = np.linspace(0.0, 2 * np.pi, 33)
_LEVELS = {Status.OK: "INFO", Status.FLAGGED: "WARN", Status.LOST: "ERROR", Status.SKIPPED: "WARN"}


class RunRecording:
    """Takes measurements as they come; use it as a context manager.

    Args:
        stream: an open recording (see `recording_to_file`).
        body: the body.
        cameras: the calibrated cameras.
        image_every: log the pictures of every n-th frame set; 0 logs none.
        videos: by camera name, recorded videos that go into the recording as they are.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        body: Body,
        cameras: Sequence[Camera],
        image_every: int,
        videos: Mapping[str, PassedVideo] | None = None,
    ) -> None:
        self._stream = stream
        self._body = body
        self._cameras = {camera.name: camera for camera in cameras}
        self._image_every = image_every
        self._videos = dict(videos or {}) if image_every else {}
        self._columns = ColumnLog(stream, FLUSH_ROWS)
        self._status = ""
        log_rig(stream, body, cameras)
        for video in self._videos.values():
            video.log(stream)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Send what is held back and close the file."""
        self._columns.flush()
        self._stream.flush()
        self._stream.disconnect()

    def add(
        self,
        measured: Measurement,
        frame_set: FrameSet | None = None,
        truth: RigidTransform | None = None,
    ) -> None:
        """Log one measurement.

        Args:
            measured: the measurement.
            frame_set: its images, where they shall be logged.
            truth: the true world_from_body at the measurement's time, where it is known.
        """
        self._columns.begin(measured.index, measured.time_s)
        self._log_status(measured)
        pictures = bool(frame_set and self._image_every and not measured.index % self._image_every)
        if frame_set is not None and pictures:
            self._log_images(measured, frame_set)
        self._log_views(measured, outlines=pictures)
        self._log_fixes(measured)
        self._log_pose(measured.pose)
        self._log_traces(measured)
        if truth is not None:
            self._log_error(measured.pose, truth)

    def summary(self, text: str) -> None:
        """A page of Markdown about the run."""
        self._stream.log(
            entities.SUMMARY, rr.TextDocument(text, media_type="text/markdown"), static=True
        )

    def _log_status(self, measured: Measurement) -> None:
        text = ": ".join(part for part in (measured.status.value, measured.reason) if part)
        if measured.pose is not None and measured.pose.flags:
            text += f" ({'; '.join(measured.pose.flags)})"
        if text != self._status:
            self._set_time(measured)
            entry = rr.TextLog(text, level=_LEVELS[measured.status])
            self._stream.log(entities.STATUS, entry)
            self._status = text

    def _set_time(self, measured: Measurement) -> None:
        self._stream.set_time(entities.TIMELINE_FRAME, sequence=measured.index)
        self._stream.set_time(entities.TIMELINE_TIME, duration=measured.time_s)

    def _log_images(self, measured: Measurement, frame_set: FrameSet) -> None:
        self._set_time(measured)
        for name, image in frame_set.images.items():
            if name in self._videos:
                time_ns = self._videos[name].time_ns(image.frame)
                self._columns.video_frame(entities.image(name), time_ns)
            elif image.encoded is not None:
                picture = rr.EncodedImage(contents=image.encoded, media_type="image/jpeg")
                self._stream.log(entities.image(name), picture)
            else:
                raw = rr.Image(image.pixels, color_model="BGR")
                self._stream.log(entities.image(name), raw.compress(jpeg_quality=90))

    def _log_views(self, measured: Measurement, outlines: bool) -> None:
        for name in self._cameras:
            seen = [v for v in measured.views if v.camera == name and v.detection is not None]
            colors = [entities.view_color(view) for view in seen]
            centers = np.array([v.detection.center_px for v in seen if v.detection]).reshape(-1, 2)
            self._columns.points2d(entities.centers(name), centers, colors)
            if outlines:
                self._columns.strips2d(entities.outlines(name), [_circle(v) for v in seen], colors)
                edges = [v.detection.outline_px for v in seen if v.detection]
                points = np.concatenate([np.zeros((0, 2)), *(e for e in edges if e is not None)])
                white = [(255, 255, 255)] * len(points)
                self._columns.points2d(entities.edges(name), points, white)

    def _log_fixes(self, measured: Measurement) -> None:
        fixes = {fix.ball: fix for fix in measured.fixes}
        for ball in self._body.balls:
            fix = fixes.get(ball.name)
            center = np.zeros((0, 3)) if fix is None else fix.center[None]
            self._columns.ellipsoids(entities.ball(ball.name), center)
            used = [] if fix is None else [self._cameras[name].center for name in fix.cameras]
            segments = np.array([[start, center[0]] for start in used]).reshape(-1, 2, 3)
            self._columns.strips3d(entities.rays(ball.name), segments)
        for (first, second), nominal in self._body.distances().items():
            value = np.nan
            if first in fixes and second in fixes:
                apart = np.linalg.norm(fixes[first].center - fixes[second].center)
                value = float(apart) - nominal
            self._columns.scalar(entities.distance(first, second), value)

    def _log_pose(self, pose: Pose | None) -> None:
        self._columns.scalar(entities.POSITION_SD, np.nan if pose is None else pose.position_sd_mm)
        if pose is None:
            self._columns.points3d(entities.TRAIL, np.zeros((0, 3)))
            return
        place = pose.world_from_body
        quat_xyzw = np.roll(place.quat_wxyz, -1)
        self._columns.transform(entities.BODY, place.translation, quat_xyzw)
        self._columns.points3d(entities.TRAIL, place.translation[None])
        values, axes = np.linalg.eigh(pose.covariance[:3, :3])
        if np.linalg.det(axes) < 0:
            axes[:, 0] = -axes[:, 0]
        turn = np.roll(RigidTransform(axes, np.zeros(3)).quat_wxyz, -1)
        half = entities.UNCERTAINTY_SCALE * np.sqrt(np.maximum(values, 0.0))
        self._columns.uncertainty(entities.UNCERTAINTY, place.translation, half, turn)

    def _log_traces(self, measured: Measurement) -> None:
        effective = {view.camera for view in measured.views if view.effective}
        self._columns.scalar(entities.EFFECTIVE_CAMERAS, len(effective))
        for name in self._cameras:
            seen = [r for (_, camera), r in measured.residuals_px.items() if camera == name]
            rms = float(np.sqrt(np.mean(np.square(seen)) * 2)) if seen else np.nan
            self._columns.scalar(entities.residual(name), rms)

    def _log_error(self, pose: Pose | None, truth: RigidTransform) -> None:
        delta = np.full(6, np.nan) if pose is None else pose.world_from_body.difference(truth)
        values = (*delta[:3], float(np.linalg.norm(delta[:3])))
        for axis, value in zip(entities.ERROR_AXES, values, strict=True):
            self._columns.scalar(entities.error(axis), float(value))
        turn = float(np.degrees(np.linalg.norm(delta[3:])))
        self._columns.scalar(entities.ROTATION_ERROR, turn)


def _circle(view: BallView) -> Floats:
    assert view.detection is not None
    around = np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    return view.detection.center_px + view.detection.radius_px * around


def open_recording(
    name: str,
    cameras: Sequence[Camera],
    path: Path | None = None,
    address: str | None = None,
) -> rr.RecordingStream:
    """A recording that is written as it goes: to a file, to a viewer that runs, or to both.

    Args:
        name: shown in the viewer.
        cameras: for the layout that travels inside.
        path: the .rrd file, overwritten; no viewer is needed for it.
        address: of a viewer, as `rerun+http://127.0.0.1:9876/proxy`.

    Raises:
        ConfigError: no viewer listens at the address.
    """
    stream = rr.RecordingStream("triball")
    if address is not None:
        _check_listening(address)
    sinks: list[rr.FileSink | rr.GrpcSink] = [rr.FileSink(path)] if path else []
    sinks += [rr.GrpcSink(address)] if address else []
    stream.set_sinks(*sinks, default_blueprint=run_blueprint(cameras))
    stream.send_recording_name(name)
    return stream


def _check_listening(address: str) -> None:
    """Rerun itself would drop everything it cannot send, and only log that."""
    parts = urlsplit(address)
    if not parts.scheme.startswith("rerun") or parts.hostname is None:
        raise ConfigError(
            f"'{address}' is no viewer's address: expected rerun+http://127.0.0.1:9876/proxy"
        )
    deadline = time.monotonic() + CONNECT_WITHIN_S
    while True:
        try:
            socket.create_connection((parts.hostname, parts.port or 9876), timeout=1.0).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise ConfigError(f"no viewer listens at {address}: {error.strerror}") from error
            time.sleep(0.1)

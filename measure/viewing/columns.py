"""Rows gathered and sent to Rerun by the column, at a fraction of the cost of single rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from measure.arrays import Floats
from measure.viewing import entities

Rgb = tuple[int, int, int]
Send = Callable[["_Rows"], Any]


@dataclass
class _Rows:
    """What one entity has gathered."""

    send: Send
    frames: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    colors: list[Sequence[Rgb]] = field(default_factory=list)

    def lengths(self) -> list[int]:
        return [len(value) for value in self.values]

    def stacked(self, width: int) -> Floats:
        rows = [np.asarray(value, dtype=np.float64).reshape(-1, width) for value in self.values]
        return np.concatenate(rows) if rows else np.zeros((0, width))

    def flat_colors(self) -> list[Rgb]:
        return [color for row in self.colors for color in row]


class ColumnLog:
    """Gathers rows by entity; `flush` sends them.

    Args:
        stream: the recording.
        flush_rows: how many frame sets are held back at most.
    """

    def __init__(self, stream: rr.RecordingStream, flush_rows: int) -> None:
        self._stream = stream
        self._flush_rows = flush_rows
        self._rows: dict[str, _Rows] = {}
        self._held = 0
        self._frame = 0
        self._time_s = 0.0

    def begin(self, frame: int, time_s: float) -> None:
        """Start a frame set: what follows belongs to it."""
        if self._held >= self._flush_rows:
            self.flush()
        self._frame, self._time_s = frame, time_s
        self._held += 1

    def scalar(self, entity: str, value: float) -> None:
        """A number; NaN leaves a gap in the plot."""
        self._add(entity, _send_scalars, float(value))

    def points3d(self, entity: str, points: Floats) -> None:
        """Points (n, 3), possibly none."""
        self._add(entity, _send_points3d, points)

    def ellipsoids(self, entity: str, centers: Floats) -> None:
        """Ellipsoid centres (n, 3), possibly none; the shape is static."""
        self._add(entity, _send_ellipsoids, centers)

    def points2d(self, entity: str, points: Floats, colors: Sequence[Rgb]) -> None:
        """Image points (n, 2) with a colour each."""
        self._add(entity, _send_points2d, points, colors)

    def strips2d(self, entity: str, strips: Sequence[Floats], colors: Sequence[Rgb]) -> None:
        """Polylines (n, m, 2) with a colour each."""
        self._add(entity, _send_strips2d, strips, colors)

    def strips3d(self, entity: str, strips: Floats) -> None:
        """Line segments (n, 2, 3)."""
        self._add(entity, _send_strips3d, strips)

    def transform(self, entity: str, translation: Floats, quat_xyzw: Floats) -> None:
        """A pose."""
        self._add(entity, _send_transforms, (translation, quat_xyzw))

    def uncertainty(self, entity: str, center: Floats, half: Floats, quat_xyzw: Floats) -> None:
        """One ellipsoid with its shape."""
        self._add(entity, _send_uncertainty, (center, half, quat_xyzw))

    def video_frame(self, entity: str, time_ns: int) -> None:
        """Which frame of the entity's video is shown: its presentation time."""
        self._add(entity, _send_video_frames, time_ns)

    def flush(self) -> None:
        """Send everything gathered."""
        for entity, rows in self._rows.items():
            index = [
                rr.TimeColumn(entities.TIMELINE_FRAME, sequence=rows.frames),
                rr.TimeColumn(entities.TIMELINE_TIME, duration=rows.times),
            ]
            self._stream.send_columns(entity, indexes=index, columns=rows.send(rows))
        self._rows.clear()
        self._held = 0

    def _add(self, entity: str, send: Send, value: Any, colors: Sequence[Rgb] = ()) -> None:
        rows = self._rows.setdefault(entity, _Rows(send))
        rows.frames.append(self._frame)
        rows.times.append(self._time_s)
        rows.values.append(value)
        rows.colors.append(colors)


def _send_scalars(rows: _Rows) -> Any:
    return rr.Scalars.columns(scalars=rows.values)


def _send_points3d(rows: _Rows) -> Any:
    return rr.Points3D.columns(positions=rows.stacked(3)).partition(rows.lengths())


def _send_ellipsoids(rows: _Rows) -> Any:
    return rr.Ellipsoids3D.columns(centers=rows.stacked(3)).partition(rows.lengths())


def _send_points2d(rows: _Rows) -> Any:
    columns = rr.Points2D.columns(positions=rows.stacked(2), colors=rows.flat_colors())
    return columns.partition(rows.lengths())


def _send_strips2d(rows: _Rows) -> Any:
    strips = [strip for row in rows.values for strip in row]
    columns = rr.LineStrips2D.columns(strips=strips, colors=rows.flat_colors())
    return columns.partition(rows.lengths())


def _send_strips3d(rows: _Rows) -> Any:
    strips = [strip for row in rows.values for strip in row]
    return rr.LineStrips3D.columns(strips=strips).partition(rows.lengths())


def _send_transforms(rows: _Rows) -> Any:
    return rr.Transform3D.columns(
        translation=np.stack([value[0] for value in rows.values]),
        quaternion=np.stack([value[1] for value in rows.values]),
    )


def _send_uncertainty(rows: _Rows) -> Any:
    return rr.Ellipsoids3D.columns(
        centers=np.stack([value[0] for value in rows.values]),
        half_sizes=np.stack([value[1] for value in rows.values]),
        quaternions=np.stack([value[2] for value in rows.values]),
    )


def _send_video_frames(rows: _Rows) -> Any:
    return rr.VideoFrameReference.columns_nanos(np.array(rows.values, dtype=np.int64))

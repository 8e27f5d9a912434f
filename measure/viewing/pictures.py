"""What was found in the cameras' pictures, in the colour of its state, and why it was not used."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import rerun as rr

from measure.arrays import Bools, Floats
from measure.measuring import Measurement
from measure.model import BallView, Body, Camera, Detection, Pose
from measure.model.observations import Reason, State
from measure.viewing import entities, state_colors
from measure.viewing.columns import FrameSetBatch, lengths, points

Colors = npt.NDArray[np.uint32]
_AROUND = np.linspace(0.0, 2 * np.pi, 33)
_CIRCLE = np.column_stack([np.cos(_AROUND), np.sin(_AROUND)])


def send_views(
    columns: FrameSetBatch,
    sets: Sequence[Measurement],
    pictured: Bools,
    body: Body,
    cameras: Sequence[Camera],
) -> None:
    """Centres of what was found, or why a ball is not used; outlines where `pictured` (n,)."""
    for camera in cameras:
        mine = [[view for view in one.views if view.camera == camera.name] for one in sets]
        seen = [[view for view in row if view.detection is not None] for row in mine]
        found = [view for row in seen for view in row]
        places = points((_detection(view).center_px for view in found), 2)
        centers = rr.Points2D.columns(positions=places, colors=_colors(found))
        columns.send(entities.centers(camera.name), centers.partition(lengths(seen)))
        _send_suspended(columns, sets, mine, body, camera)
        if pictured.any():
            kept = [row for row, shown in zip(seen, pictured, strict=True) if shown]
            _send_outlines(columns, kept, pictured, camera.name)


def _send_outlines(
    columns: FrameSetBatch, seen: Sequence[Sequence[BallView]], rows: Bools, camera: str
) -> None:
    """The circles and the edge points that were measured."""
    views = [view for row in seen for view in row]
    found, colors = [_detection(view) for view in views], _colors(views)
    circles = [one.center_px + one.radius_px * _CIRCLE for one in found]
    strips = rr.LineStrips2D.columns(strips=circles, colors=colors)
    columns.send(entities.outlines(camera), strips.partition(lengths(seen)), rows=rows)
    none = np.zeros((0, 2))
    edges = [none if one.outline_px is None else one.outline_px for one in found]
    counts = np.array(lengths(edges), dtype=np.int64)
    dots = rr.Points2D.columns(positions=points(edges, 2), colors=np.repeat(colors, counts))
    last = np.cumsum([0, *lengths(seen)])
    before = np.cumsum([0, *counts])
    columns.send(entities.edges(camera), dots.partition(np.diff(before[last])), rows=rows)


def _send_suspended(
    columns: FrameSetBatch,
    sets: Sequence[Measurement],
    views: Sequence[Sequence[BallView]],
    body: Body,
    camera: Camera,
) -> None:
    """The balls that are not used, and why: where they were found, else where the pose has them."""
    idle = [(at, v) for at, row in enumerate(views) for v in row if v.state is State.SUSPENDED]
    places = _expected([(sets[at].pose, view.ball) for at, view in idle], body, camera)
    for number, (_, view) in enumerate(idle):
        if view.detection is not None:
            places[number] = view.detection.center_px
    # A mark beside the picture would shrink the picture in the viewer.
    inside = np.all((places >= 0) & (places < camera.intrinsics.size_wh), axis=1)
    shown = [view for (_, view), here in zip(idle, inside, strict=True) if here]
    marks = rr.Points2D.columns(
        positions=places[inside],
        colors=_colors(shown),
        labels=[f"{view.ball}: {view.reason}" for view in shown],
    )
    rows = np.array([at for at, _ in idle], dtype=np.int64)[inside]
    counts = np.bincount(rows, minlength=len(sets))
    columns.send(entities.suspended(camera.name), marks.partition(counts))


def _expected(wanted: Sequence[tuple[Pose | None, str]], body: Body, camera: Camera) -> Floats:
    """Where poses put balls in the picture (n, 2); NaN without a pose or out of sight."""
    centers = dict(zip(body.names, body.centers, strict=True))
    placed = [
        np.full(3, np.nan) if pose is None else pose.world_from_body.apply(centers[ball])
        for pose, ball in wanted
    ]
    return np.array(camera.project(points(placed, 3))) if placed else np.zeros((0, 2))


def _detection(view: BallView) -> Detection:
    assert view.detection is not None
    return view.detection


def _colors(views: Sequence[BallView]) -> Colors:
    """Packed RGBA (n,) for the state of each view."""
    why = [None if view.state is State.EFFECTIVE else view.reason for view in views]
    return np.array([_PACKED[reason] for reason in why], dtype=np.uint32)


def _pack(color: tuple[int, int, int]) -> int:
    red, green, blue = color
    return red << 24 | green << 16 | blue << 8 | 255


_PACKED = {None: _pack(state_colors.EFFECTIVE)} | {
    reason: _pack(state_colors.REASONS.get(reason, state_colors.UNKNOWN)) for reason in Reason
}

"""What stays the same through a recording: cameras, shapes, colours."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from measure.model import Body, Camera
from measure.viewing import entities


def log_rig(stream: rr.RecordingStream, body: Body, cameras: Sequence[Camera]) -> None:
    """Log the cameras, the balls' shapes and the style of every trace, outside of time."""
    stream.log(entities.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for camera in cameras:
        _log_camera(stream, camera)
    _log_body(stream, body)
    lines = {entities.error(axis): (axis, color) for axis, color in entities.ERROR_COLORS.items()}
    for index, camera in enumerate(cameras):
        lines[entities.residual(camera.name)] = (camera.name, entities.line_color(index))
    for index, (first, second) in enumerate(body.distances()):
        lines[entities.distance(first, second)] = (f"{first}-{second}", entities.line_color(index))
    log_lines(stream, lines)


def log_lines(
    stream: rr.RecordingStream, lines: dict[str, tuple[str, tuple[int, int, int]]]
) -> None:
    """Name and colour of the traces, by entity."""
    for entity, (name, color) in lines.items():
        style = rr.SeriesLines(colors=[color], names=[name], widths=[1.5])
        stream.log(entity, style, static=True)


def _log_camera(stream: rr.RecordingStream, camera: Camera) -> None:
    pose, lens = camera.world_from_camera, camera.intrinsics
    stream.log(
        entities.camera(camera.name),
        rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation),
        rr.Pinhole(
            image_from_camera=lens.matrix,
            resolution=lens.size_wh,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=90.0,
        ),
        static=True,
    )
    dots = rr.Points2D.from_fields(radii=rr.Radius.ui_points(1.5))
    stream.log(entities.edges(camera.name), dots, static=True)
    why = rr.Points2D.from_fields(radii=rr.Radius.ui_points(4.0), show_labels=True)
    stream.log(entities.suspended(camera.name), why, static=True)


def _log_body(stream: rr.RecordingStream, body: Body) -> None:
    for index, ball in enumerate(body.balls):
        color = entities.ball_color(ball.color.name, index)
        shape = rr.Ellipsoids3D.from_fields(
            half_sizes=[[ball.radius_mm] * 3],
            colors=[color],
            fill_mode="solid",
            labels=[ball.name],
            show_labels=False,
        )
        stream.log(entities.ball(ball.name), shape, static=True)
        rays = rr.LineStrips3D.from_fields(colors=[(*color, 150)], radii=[0.25])
        stream.log(entities.rays(ball.name), rays, static=True)
    trail = rr.Points3D.from_fields(colors=[(120, 200, 255)], radii=[0.6])
    stream.log(entities.TRAIL, trail, static=True)
    haze = rr.Ellipsoids3D.from_fields(colors=[(255, 120, 220)], fill_mode="majorwireframe")
    stream.log(entities.UNCERTAINTY, haze, static=True)

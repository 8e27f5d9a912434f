"""What is sent of frame sets: the 3-D scene, traces over time, and what was found in pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from measure.arrays import Bools, Bytes, Floats
from measure.geometry import RigidTransform
from measure.measuring import Measurement
from measure.model import BallView, Body, Camera, Detection, Image, Pose
from measure.model.observations import State
from measure.session import Trajectory
from measure.viewing import entities, state_colors
from measure.viewing.entities import FrameSetBatch, lengths, points
from measure.viewing.state_colors import AXES_MM


def send_balls(
    columns: FrameSetBatch, sets: Sequence[Measurement], body: Body, cameras: Sequence[Camera]
) -> None:
    """Every ball's position, the rays that made it, and how far the balls are apart."""
    centers = np.full((len(sets), len(body.balls), 3), np.nan)
    eyes = {camera.name: camera.center for camera in cameras}
    for number, ball in enumerate(body.balls):
        positions = [
            [position for position in one.positions if position.ball == ball.name] for one in sets
        ]
        here = np.array(lengths(positions), dtype=bool)
        places = points((position.center for row in positions for position in row), 3)
        centers[here, number] = places
        shown = rr.Ellipsoids3D.columns(centers=places).partition(here)
        columns.send(entities.ball(ball.name), shown)
        used = [[name for position in row for name in position.cameras] for row in positions]
        ends = np.repeat(centers[:, number], lengths(used), axis=0)
        starts = points((eyes[name] for row in used for name in row), 3)
        strips = rr.LineStrips3D.columns(strips=np.stack([starts, ends], axis=1))
        columns.send(entities.rays(ball.name), strips.partition(lengths(used)))
    names = list(body.names)
    for (first, second), nominal in body.distances().items():
        apart = centers[:, names.index(first)] - centers[:, names.index(second)]
        columns.scalars(entities.distance(first, second), np.linalg.norm(apart, axis=1) - nominal)


@dataclass
class PosesBefore:
    """What a body's earlier poses settled for those that follow."""

    first: Rotation | None = None  # rotation, which plots are relative to
    enlarged: float = 0.0  # how many times as large as it is the uncertainty is drawn


def send_poses(
    columns: FrameSetBatch, sets: Sequence[Measurement], body: Body, before: PosesBefore
) -> None:
    """The body's axes, trail and uncertainty; without a pose none of them is shown."""
    poses = [one.pose for one in sets if one.pose is not None]
    here = np.array([one.pose is not None for one in sets])
    place, turn = np.zeros((len(sets), 3)), np.zeros((len(sets), 4))
    turn[:, 3] = 1.0
    covariance = np.array([pose.covariance[:3, :3] for pose in poses]).reshape(-1, 3, 3)
    if poses:
        place[here] = [pose.world_from_body.translation for pose in poses]
        rotations = np.stack([pose.world_from_body.rotation for pose in poses])
        turn[here] = Rotation.from_matrix(rotations).as_quat()
    # What was logged last stays in view: a frame set without a pose must wipe the axes away.
    columns.send(
        entities.BODY,
        rr.Transform3D.columns(translation=place, quaternion=turn),
        rr.TransformAxes3D.columns(axis_length=AXES_MM * here),
    )
    trail = rr.Points3D.columns(positions=place[here])
    columns.send(entities.TRAIL, trail.partition(here.astype(int)))
    half, axes = _ellipsoids(covariance)
    if poses:
        # About a ball's size; as long as that holds, the factor stays for sizes to be compared.
        fits = body.balls[0].radius_mm / max(np.median(half.max(axis=1)), 1e-9)
        if not before.enlarged / 10 < fits < before.enlarged * 10:
            before.enlarged = 10.0 ** np.round(np.log10(fits))
    half *= before.enlarged
    labels = [f"SD x{before.enlarged:g}"] * len(poses)
    haze = rr.Ellipsoids3D.columns(
        centers=place[here], half_sizes=half, quaternions=axes, labels=labels
    )
    columns.send(entities.UNCERTAINTY, haze.partition(here.astype(int)))
    sd = np.full(len(sets), np.nan)
    sd[here] = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    columns.scalars(entities.POSITION_SD, sd)
    along = np.full((len(sets), 6), np.nan)
    if poses:
        turns = Rotation.from_quat(turn[here])
        if before.first is None:
            before.first = turns[0]
        since = turns * before.first.inv()
        along[here] = np.hstack([place[here], since.as_rotvec(degrees=True)])
    for axis, moved, turned in zip("xyz", along[:, :3].T, along[:, 3:].T, strict=True):
        columns.scalars(entities.position(axis), moved)
        columns.scalars(entities.rotation(axis), turned)


def send_traces(
    columns: FrameSetBatch, sets: Sequence[Measurement], cameras: Sequence[Camera]
) -> None:
    """RMS residual of each camera, and how many cameras see something that is used."""
    squares, counts = np.zeros((2, len(cameras), len(sets)))
    numbers = {camera.name: number for number, camera in enumerate(cameras)}
    cells = [(numbers[name], at) for at, one in enumerate(sets) for _, name in one.residuals_px]
    if cells:
        off = np.array([value for one in sets for value in one.residuals_px.values()])
        here = tuple(np.array(cells).T)
        np.add.at(squares, here, np.sum(off**2, axis=1))
        np.add.at(counts, here, 1)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(squares / counts)
    for camera, values in zip(cameras, rms, strict=True):
        columns.scalars(entities.residual(camera.name), values)
    working = [len({view.camera for view in one.views if view.effective}) for one in sets]
    columns.scalars(entities.EFFECTIVE_CAMERAS, np.array(working, dtype=np.float64))


def send_errors(columns: FrameSetBatch, sets: Sequence[Measurement], truth: Trajectory) -> None:
    """Position and rotation error; frame sets that the truth does not cover have no row."""
    rows = truth.covers(columns.times_s)
    if not rows.any():
        return
    poses = [one.pose for one, covered in zip(sets, rows, strict=True) if covered]
    here = np.array([pose is not None for pose in poses])
    delta = np.full((len(poses), 6), np.nan)
    if here.any():
        found = [pose.world_from_body for pose in poses if pose is not None]
        measured = RigidTransform.stack(found)
        delta[here] = measured.difference(truth.at(columns.times_s[rows][here]))
    values = np.column_stack([delta[:, :3], np.linalg.norm(delta[:, :3], axis=1)])
    for axis, column in zip(entities.ERROR_AXES, values.T, strict=True):
        columns.scalars(entities.error(axis), column, rows)
    turn = np.degrees(np.linalg.norm(delta[:, 3:], axis=1))
    columns.scalars(entities.ROTATION_ERROR, turn, rows)


def _ellipsoids(covariances: Floats) -> tuple[Floats, Floats]:
    """Half axes (n, 3), and their rotations (n, 4), scalar last."""
    values, axes = np.linalg.eigh(covariances)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    return np.sqrt(np.maximum(values, 0.0)), Rotation.from_matrix(axes).as_quat()


def log_rig(stream: entities.Stream, bodies: Sequence[Body], cameras: Sequence[Camera]) -> None:
    """Log the cameras, the balls' shapes and the style of every trace, outside of time."""
    stream.log(entities.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for camera in cameras:
        _log_camera(stream, camera)
    for body in bodies:
        end = entities.suffix(body.name, len(bodies) > 1)
        of = f" {body.name}" if end else ""
        _log_body(stream, body, end)
        lines = {
            entities.error(axis) + end: (axis + of, color)
            for axis, color in entities.ERROR_COLORS.items()
        }
        for axis in "xyz":
            for entity in (entities.position(axis), entities.rotation(axis)):
                lines[entity + end] = (axis + of, entities.ERROR_COLORS[axis])
        for index, camera in enumerate(cameras):
            color = entities.line_color(index)
            lines[entities.residual(camera.name) + end] = (camera.name + of, color)
            _log_dots(stream, camera, end)
        for index, (first, second) in enumerate(body.distances()):
            name = f"{first}-{second}{of}"
            lines[entities.distance(first, second) + end] = (name, entities.line_color(index))
        log_lines(stream, lines)


def log_lines(stream: entities.Stream, lines: dict[str, tuple[str, tuple[int, int, int]]]) -> None:
    """Name and colour of the traces, by entity."""
    for entity, (name, color) in lines.items():
        style = rr.SeriesLines(colors=[color], names=[name], widths=[1.5])
        stream.log(entity, style, static=True)


def _log_camera(stream: entities.Stream, camera: Camera) -> None:
    pose, lens = camera.world_from_camera, camera.intrinsics
    stream.log(
        entities.camera(camera.name),
        rr.Transform3D(translation=pose.translation, mat3x3=pose.rotation),
        rr.Pinhole(
            image_from_camera=lens.matrix,
            resolution=lens.size_wh,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=60.0,
        ),
        static=True,
    )


def _log_dots(stream: entities.Stream, camera: Camera, end: str) -> None:
    """Size of the marks in a camera's picture."""
    dots = rr.Points2D.from_fields(radii=rr.Radius.ui_points(1.5))
    stream.log(entities.edges(camera.name) + end, dots, static=True)
    why = rr.Points2D.from_fields(radii=rr.Radius.ui_points(4.0), show_labels=True)
    stream.log(entities.suspended(camera.name) + end, why, static=True)


def _log_body(stream: entities.Stream, body: Body, end: str) -> None:
    for index, ball in enumerate(body.balls):
        color = entities.ball_color(ball.color.name, index)
        shape = rr.Ellipsoids3D.from_fields(
            half_sizes=[[ball.radius_mm] * 3],
            colors=[color],
            fill_mode="solid",
            labels=[ball.name],
            show_labels=False,
        )
        stream.log(entities.ball(ball.name) + end, shape, static=True)
        rays = rr.LineStrips3D.from_fields(colors=[(*color, 150)], radii=[0.25])
        stream.log(entities.rays(ball.name) + end, rays, static=True)
    trail = rr.Points3D.from_fields(colors=[(120, 200, 255)], radii=[0.6])
    stream.log(entities.TRAIL + end, trail, static=True)
    haze = rr.Ellipsoids3D.from_fields(colors=[(255, 60, 200)], fill_mode="densewireframe")
    stream.log(entities.UNCERTAINTY + end, haze, static=True)


_AROUND = np.linspace(0.0, 2 * np.pi, 33)
_CIRCLE = np.column_stack([np.cos(_AROUND), np.sin(_AROUND)])


def picture_of(image: Image) -> rr.AsComponents:
    """A picture as it is logged, as the camera compressed it if it did."""
    if image.encoded is not None:
        return rr.EncodedImage(contents=image.encoded, media_type="image/jpeg")
    return rr.Image(image.pixels, color_model="BGR").compress(jpeg_quality=90)


def send_views(
    columns: FrameSetBatch,
    sets: Sequence[Measurement],
    pictured: Bools,
    body: Body,
    cameras: Sequence[Camera],
    has_pictures: bool,
) -> None:
    """Centres of what was found, or why a ball is not used; outlines where `pictured` (n,).

    Where the recording has pictures, centres stand in those frame sets alone: in a picture of
    another instant they would lie beside the balls.
    """
    rows = pictured if has_pictures else np.ones(len(sets), dtype=bool)
    sets = [one for one, is_marked in zip(sets, rows, strict=True) if is_marked]
    for camera in cameras if sets else ():
        mine = [[view for view in one.views if view.camera == camera.name] for one in sets]
        seen = [[view for view in row if view.detection is not None] for row in mine]
        found = [view for row in seen for view in row]
        places = points((_detection(view).center_px for view in found), 2)
        centers = rr.Points2D.columns(positions=places, colors=_colors(found))
        columns.send(entities.centers(camera.name), centers.partition(lengths(seen)), rows=rows)
        _send_suspended(columns, sets, mine, rows, body, camera)
        if has_pictures:
            _send_outlines(columns, seen, rows, camera.name)


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
    dots = rr.Points2D.columns(positions=points(edges, 2), colors=np.repeat(colors, counts, axis=0))
    last = np.cumsum([0, *lengths(seen)])
    before = np.cumsum([0, *counts])
    columns.send(entities.edges(camera), dots.partition(np.diff(before[last])), rows=rows)


def _send_suspended(
    columns: FrameSetBatch,
    sets: Sequence[Measurement],
    views: Sequence[Sequence[BallView]],
    rows: Bools,
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
    of = np.array([at for at, _ in idle], dtype=np.int64)[inside]
    counts = np.bincount(of, minlength=len(sets))
    columns.send(entities.suspended(camera.name), marks.partition(counts), rows=rows)


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


def _colors(views: Sequence[BallView]) -> Bytes:
    """RGB (n, 3) for the state of each view."""
    colors = [state_colors.REASONS.get(view.reason, state_colors.UNKNOWN) for view in views]
    return np.array(colors, np.uint8).reshape(-1, 3)

"""Pictures with what was found drawn in: a single one, or one instant of a run by all cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pyarrow.compute as pc

from measure.arrays import Bytes, Floats
from measure.errors import ConfigError, DegenerateGeometryError, RunError
from measure.geometry import RigidTransform, tangent_cone
from measure.model import Body, Camera, Detection
from measure.results import Run
from measure.session import Session
from measure.viewing.state_colors import AXES_MM

TILE_WH = (640, 360)
_FRACTION_BITS = 4  # Bits of a pixel's fraction in OpenCV's drawing
_AXIS_COLOURS = ((80, 80, 255), (90, 220, 90), (255, 150, 80))
_FOUND, _NOT_FOUND, _DARK = (255, 255, 255), (150, 150, 150), (0, 0, 0)


def draw_mosaic(session: Session, runs: Sequence[Run], index: int) -> Bytes:
    """The views of one frame set with all bodies measured, two a row, as BGR pixels.

    White: the outline of each ball that was used, as the measured pose puts it; grey and dashed: a
    ball that was not used in that view. The axes are the body's, x red, y green, z blue.
    """
    found = [
        (run.body, _pose(run, index), run.detections.filter(pc.field("index") == index).to_pylist())
        for run in runs
    ]
    tiles = []
    for camera in runs[0].cameras:
        seen = [[v for v in views if v["camera"] == camera.name] for _, _, views in found]
        frames = [v["frame"] for views in seen for v in views if v["frame"] is not None]
        picture = _picture(session, camera, frames[0] if frames else None)
        for (body, pose, _), views in zip(found, seen, strict=True):
            used = {v["ball"] for v in views if v["state"] == "effective"}
            if pose is not None:
                _draw_body(picture, camera, body, pose, used)
        tiles.append(_tile(picture, camera.name))
    if len(tiles) % 2:
        tiles.append(np.zeros_like(tiles[0]))
    return np.vstack([np.hstack(tiles[k : k + 2]) for k in range(0, len(tiles), 2)])


def _pose(run: Run, index: int) -> RigidTransform | None:
    indices = run.poses["index"].to_pylist()
    if index not in indices:
        raise RunError(f"{run.path} has no frame set {index}; it has {len(indices)}")
    row = indices.index(index)
    if not run.has_pose[row]:
        return None
    return run.world_from_body[int(np.count_nonzero(run.has_pose[:row]))]


def jpeg_of(pixels: Bytes) -> bytes:
    """BGR pixels as the bytes of a JPEG file."""
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def write_mosaic(session: Session, runs: Sequence[Run], index: int, path: Path) -> None:
    """`draw_mosaic` into a PNG file, smoothed a little and in 64 levels: noise would swell it."""
    smooth = cv2.bilateralFilter(draw_mosaic(session, runs, index), 9, 18, 5)
    mosaic = np.asarray(smooth // 4 * 4 + 2, dtype=np.uint8)
    _write(mosaic, path, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def write_outlines(
    pixels: Bytes, detections: Sequence[Detection], outlines_px: Sequence[Floats], path: Path
) -> None:
    """Write a BGR picture (h, w, 3) with outline, centre, name and score of every detection.

    Args:
        outlines_px: points (n, 2) around each detection.
    """
    picture = pixels.copy()
    for detection, outline in reversed(list(zip(detections, outlines_px, strict=True))):
        _draw_outline(picture, detection, outline)  # the best on top
    _write(picture, path)


def _write(picture: Bytes, path: Path, options: Sequence[int] = ()) -> None:
    done, encoded = cv2.imencode(path.suffix, picture, options)
    if not done:
        raise ConfigError(f"{path}: cannot be written as a picture")
    path.write_bytes(encoded.tobytes())


def _picture(session: Session, camera: Camera, frame: int | None) -> Bytes:
    width, height = camera.intrinsics.size_wh
    if frame is None:
        return np.zeros((height, width, 3), np.uint8)
    stream = next(s for s in session.streams.values() if s.name == camera.name)
    return stream.read(frame).pixels.copy()


def _tile(picture: Bytes, name: str) -> Bytes:
    tile = np.asarray(cv2.resize(picture, TILE_WH, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    cv2.putText(tile, name, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _FOUND, 1, cv2.LINE_AA)
    return tile


def _draw_body(
    picture: Bytes, camera: Camera, body: Body, world_from_body: RigidTransform, used: set[str]
) -> None:
    camera_from_body = camera.camera_from_world @ world_from_body
    for ball in body.balls:
        try:
            cone = tangent_cone(camera_from_body.apply(ball.center_mm), ball.radius_mm)
        except DegenerateGeometryError:
            continue
        outline = camera.intrinsics.project(cone.bearings(np.linspace(0, 2 * np.pi, 73)))
        if ball.name in used:
            _lines(picture, outline, _FOUND, 3)
        else:
            for k in range(0, 72, 4):
                _lines(picture, outline[k : k + 3], _NOT_FOUND, 2)
    ends = np.vstack([np.zeros(3), AXES_MM * np.eye(3)])
    pixels = camera.intrinsics.project(camera_from_body.apply(ends))
    for end, colour in zip(pixels[1:], _AXIS_COLOURS, strict=True):
        _lines(picture, np.stack([pixels[0], end]), colour, 4)


def _lines(picture: Bytes, points: Floats, colour: tuple[int, int, int], thickness: int) -> None:
    """A polyline through points (n, 2), placed to a fraction of a pixel."""
    if not np.isfinite(points).all():
        return
    fixed = np.rint(points * (1 << _FRACTION_BITS)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [fixed], False, colour, thickness, cv2.LINE_AA, _FRACTION_BITS)


def _draw_outline(picture: Bytes, detection: Detection, outline: Floats) -> None:
    u, v = detection.center_px.tolist()
    size = max(picture.shape[0] / 720, 0.4)
    closed = np.vstack([outline, outline[:1]])
    text = f"{detection.ball} {detection.score:.2f}"
    corner = round(u + 0.75 * detection.radius_px), round(v - 0.75 * detection.radius_px)
    for color, width in ((_DARK, 3), (_FOUND, 1)):
        thick = max(1, round(width * size))
        _lines(picture, closed, color, thick)
        cv2.drawMarker(
            picture, (round(u), round(v)), color, cv2.MARKER_CROSS, round(8 * size), thick
        )
        cv2.putText(
            picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.6 * size, color, thick, cv2.LINE_AA
        )

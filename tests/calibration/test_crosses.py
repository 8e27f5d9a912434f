"""Crosses as markers, drawn in perspective, blurred, noisy and compressed."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.arrays import Bytes, Floats
from measure.calibration import MarkerField, find_markers
from measure.errors import CalibrationError
from measure.model import Camera
from tests.calibration.rigs import SIZE, cameras, looking_at, markers

FINE = 8
NAMES = tuple(f"m{i:02d}" for i in range(16))
FIELD = MarkerField(NAMES, markers())


def bars(place: Floats, facing: Floats, length_mm: float, width_mm: float) -> list[Floats]:
    """Two rectangles (4, 3) that cross at a place, in a plane whose normal is `facing`'s z axis."""
    out = []
    for along, across in ((facing[:, 0], facing[:, 1]), (facing[:, 1], facing[:, 0])):
        ends, sides = length_mm / 2 * along, width_mm / 2 * across
        out.append(place + np.array([ends + sides, ends - sides, -ends - sides, sides - ends]))
    return out


def picture(
    camera: Camera,
    places: Floats,
    rng: np.random.Generator,
    ink: int = 215,
    ground: int = 40,
    noise: float = 3.0,
) -> Bytes:
    """Crosses of 14 mm, tilted by up to 40 degrees and turned at will, as a JPEG shows them."""
    half, pad = 60, 160
    canvas = np.full((SIZE[1] + 2 * pad, SIZE[0] + 2 * pad), float(ground))
    for place in places:
        turn = looking_at(camera.center, place + rng.uniform(-250, 250, 3)).rotation
        turn = turn @ cv2.Rodrigues(np.array([0, 0, rng.uniform(0, np.pi)]))[0]
        corner = np.rint(camera.project(place[None])[0]).astype(int) - half
        if np.any(corner < -2 * half) or np.any(corner > SIZE):
            continue
        patch = np.full((2 * half * FINE, 2 * half * FINE), ground, np.uint8)
        for bar in bars(place, turn, 14.0, 2.0):
            outline = (camera.project(bar) - corner + 0.5) * FINE - 0.5
            cv2.fillConvexPoly(patch, np.rint(outline * 256).astype(np.int32), ink, shift=8)
        part = cv2.resize(patch, (2 * half, 2 * half), interpolation=cv2.INTER_AREA)
        u, v = corner + pad
        seen = canvas[v : v + 2 * half, u : u + 2 * half]
        seen[part != ground] = part[part != ground]
    canvas = canvas[pad:-pad, pad:-pad]
    blurred = cv2.GaussianBlur(canvas, (0, 0), 0.8) + rng.normal(0, noise, canvas.shape)
    gray = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", np.dstack([gray] * 3), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def errors(camera: Camera, found: dict[str, Floats]) -> Floats:
    ids = [NAMES.index(name) for name in found]
    return np.stack(list(found.values())) - camera.project(FIELD.points[ids])


def rough(camera: Camera) -> Camera:
    pose = camera.world_from_camera.perturb([2.0, -1.0, 1.5, 0.004, -0.003, 0.005])
    return replace(camera, world_from_camera=pose)


@pytest.mark.parametrize(("ink", "ground"), [(215, 40), (40, 200)])
def test_crosses_are_found_and_named_to_hundredths_of_a_pixel(ink: int, ground: int) -> None:
    everything = []
    for number, camera in enumerate(cameras()[:2]):
        shown = picture(camera, FIELD.points, np.random.default_rng(number), ink, ground)
        found = find_markers(shown, rough(camera), FIELD, "cross")
        assert len(found.marks) >= 12
        everything.append(errors(camera, found.marks))
    assert np.sqrt(np.mean(np.concatenate(everything) ** 2)) < 0.05
    assert np.abs(np.concatenate(everything)).max() < 0.15


def test_a_missing_and_a_smudged_cross_are_left_out_and_named() -> None:
    camera = cameras()[1]
    visible = camera.intrinsics.contains(camera.project(FIELD.points), 20.0)
    gone, smudged = np.flatnonzero(visible)[[2, 5]]
    kept = [i for i in range(16) if i != gone]
    shown = picture(camera, FIELD.points[kept], np.random.default_rng(1))
    u, v = np.rint(camera.project(FIELD.points[smudged][None])[0]).astype(int)
    shown[v - 14 : v + 15, u - 14 : u + 15] = cv2.circle(
        np.full((29, 29, 3), 40, np.uint8), (14, 14), 12, (215, 215, 215), -1
    )
    found = find_markers(shown, rough(camera), FIELD, "cross")
    assert NAMES[gone] in found.doubtful
    assert NAMES[smudged] in found.doubtful
    assert not {NAMES[gone], NAMES[smudged]} & set(found.marks)
    assert np.abs(errors(camera, found.marks)).max() < 0.5


def test_dots_are_no_crosses() -> None:
    camera = cameras()[0]
    shown = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    for u, v in np.rint(camera.project(FIELD.points)).astype(int):
        cv2.circle(shown, (int(u), int(v)), 7, (215, 215, 215), -1)
    with pytest.raises(CalibrationError, match="0 crosses in the marker picture"):
        find_markers(shown, rough(camera), FIELD, "cross")

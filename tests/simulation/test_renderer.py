"""Pictures against the analytic outline of a sphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measure.geometry import RigidTransform, tangent_cone
from measure.model import Camera, Intrinsics, paper_body
from measure.simulation import (
    CameraSensor,
    Lighting,
    Material,
    Renderer,
    Scene,
    Sphere,
    Still,
    render,
)
from measure.simulation.catalogue import PLASTIC, look_at, plain_lighting

FLAT_LIGHT = Lighting((), (1.0, 1.0, 1.0), below=1.0)
LENS = np.array([0.08, -0.15, 0.001, -0.0012, 0.03])


def small_camera(distortion: np.ndarray = LENS) -> Camera:
    matrix = np.array([[700.0, 0, 155.3], [0, 702.0, 121.8], [0, 0, 1]])
    pose = look_at(np.array([250.0, -300.0, 420.0]), np.array([5.0, 3.0, 250.0]))
    return Camera("cam0", Intrinsics((320, 240), matrix, distortion), pose)


def white_scene(position: tuple[float, float, float] = (0.0, 0.0, 250.0), **changes) -> Scene:
    """One white ball under light from all sides, so radiance is coverage."""
    ball = Sphere(np.array(position), 20.0, Material((1.0, 1.0, 1.0)))
    scene = Scene(
        "white",
        paper_body(),
        (small_camera(),),
        Still(RigidTransform.identity()),
        FLAT_LIGHT,
        fixed=(ball,),
        sensor=CameraSensor(blur_px=0.0),
        shown=(),
    )
    return replace(scene, **changes)


def exact_coverage(camera: Camera, center, pixels, count: int = 48) -> np.ndarray:
    """Share of each pixel (n, 2) inside the outline, by many rays through the lens model."""
    cone = tangent_cone(camera.camera_from_world.apply(center), 20.0)
    inner = (np.arange(count) + 0.5) / count - 0.5
    offsets = np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    rays = camera.intrinsics.unproject((pixels[:, None] + offsets).reshape(-1, 2))
    return (cone.residuals(rays) < 0).reshape(len(pixels), -1).mean(axis=1)


@pytest.mark.parametrize(
    "position", [(0.0, 0.0, 250.0), (55.0, 20.0, 270.0), (-40.0, -50.0, 235.0)]
)
def test_silhouette_is_the_tangent_cone(position) -> None:
    scene = white_scene(position)
    camera = scene.cameras[0]
    picture = Renderer(scene, "cam0").radiance(0.0)[..., 0]
    v, u = np.nonzero((picture > 0.001) & (picture < 0.999))
    pixels = np.column_stack([u, v]).astype(float)
    error = picture[v, u] - exact_coverage(camera, position, pixels)
    # Coverage error is edge displacement in px, where the edge crosses the whole pixel.
    assert len(pixels) > 150
    assert np.abs(error).max() < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.011
    assert abs(error.mean()) < 0.0015


def test_centroid_of_a_ball_is_the_centroid_of_its_outline() -> None:
    scene = white_scene((30.0, -20.0, 260.0))
    camera = scene.cameras[0]
    picture = Renderer(scene, "cam0").radiance(0.0)[..., 0].astype(float)
    rows, columns = np.mgrid[0:240, 0:320]
    centroid = np.array([np.sum(columns * picture), np.sum(rows * picture)]) / picture.sum()
    cone = tangent_cone(camera.camera_from_world.apply((30.0, -20.0, 260.0)), 20.0)
    outline = camera.intrinsics.project(cone.bearings(np.linspace(0, 2 * np.pi, 4001)))
    a, b = outline[:-1], outline[1:]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    expected = ((a + b) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    assert np.abs(centroid - expected).max() < 0.002
    assert picture.sum() == pytest.approx(abs(cross.sum()) / 2, rel=2e-4)


def test_nearer_ball_hides_the_farther_one() -> None:
    camera = small_camera()
    towards = (np.array([0.0, 0.0, 250.0]) - camera.center) / 435
    grey = Sphere(np.array([0.0, 0.0, 250.0]) + 60 * towards, 20.0, Material((0.5, 0.5, 0.5)))
    scene = white_scene()
    both = Renderer(replace(scene, fixed=(*scene.fixed, grey)), "cam0").radiance(0.0)[..., 0]
    alone = Renderer(scene, "cam0").radiance(0.0)[..., 0]
    inside = alone > 0.999
    assert np.array_equal(both[inside], alone[inside])
    ring = (both > 0.4) & (alone == 0)
    assert not ring.any(), "a ball of one size farther off on the same ray is hidden altogether"


def test_pictures_repeat_with_the_seed_and_differ_between_frames() -> None:
    scene = replace(
        white_scene(),
        shown=None,
        finish=PLASTIC,
        lighting=plain_lighting(),
        sensor=CameraSensor(level_noise=2.0),
        trajectory=Still(RigidTransform(np.eye(3), np.array([0, 0, 250.0]))),
    )
    first = render(scene, "cam0", 0.0, frame=3)
    assert np.array_equal(first, render(scene, scene.cameras[0], 0.0, frame=3))
    assert not np.array_equal(first, render(scene, "cam0", 0.0, frame=4))
    assert not np.array_equal(first, render(replace(scene, seed=1), "cam0", 0.0, frame=3))

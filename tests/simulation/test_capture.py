"""Capture folders: boards and dots are where the text files say."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.simulation import CameraSensor, Renderer
from measure.simulation.renderer import reduced
from tests.simulated.boards import Chessboard, charuco
from tests.simulated.capture import CaptureScene, write_capture
from tests.simulation.test_renderer import FLAT_LIGHT, small_camera, white_scene


def small_capture(**changes) -> CaptureScene:
    scene = CaptureScene(boards_per_camera=2, sensor=CameraSensor(blur_px=0.6))
    cameras = tuple(replace(c, intrinsics=reduced(c.intrinsics, 2)) for c in scene.cameras)
    return replace(scene, cameras=cameras, **changes)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    scene = small_capture()
    scene = replace(scene, cameras=scene.cameras[:2], boards_per_camera=1)
    return scene, write_capture(scene, tmp_path_factory.mktemp("capture"))


def corners_of(folder, path: str) -> np.ndarray:
    gray = cv2.imread(str(folder / path), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCornersSB(gray, (9, 6))
    assert found, path
    return corners.reshape(-1, 2)


def test_boards_stand_where_the_files_say(captured) -> None:
    scene, folder = captured
    tables = tomllib.loads((folder / "capture.toml").read_text())["cameras"]
    for camera, table in zip(scene.cameras, tables, strict=True):
        pose = RigidTransform.from_quat_wxyz(
            table["board_quat_wxyz"], table["board_translation_mm"]
        )
        expected = camera.project(pose.apply(scene.board.points))
        corners = corners_of(folder, table["board_image"])
        off = min(np.abs(c - expected).mean() for c in (corners, corners[::-1]))
        assert off < 0.06, camera.name


def test_the_square_before_the_origin_is_black(captured) -> None:
    scene, folder = captured
    camera = scene.cameras[1]
    gray = cv2.imread(str(folder / "extrinsic/cam1_board.jpg"), cv2.IMREAD_GRAYSCALE)
    half = scene.board.square_mm / 2
    points = np.array([[-half, -half, 0], [8.5 * 25, 5.5 * 25, 0], [half, -half, 0]])
    pixels = camera.project(scene.extrinsic_pose(camera).apply(points))
    black, white, next_to_it = (gray[round(float(v)), round(float(u))] for u, v in pixels)
    assert black + 80 < min(white, next_to_it)


def test_dots_are_where_the_truth_says(captured) -> None:
    scene, folder = captured
    camera = scene.cameras[0]
    gray = cv2.imread(str(folder / "extrinsic/cam0_markers.jpg"), cv2.IMREAD_GRAYSCALE)
    for name, mark in replace(scene, mark_sd_px=0.0).marks(camera).items():
        u, v = np.rint(mark).astype(int)
        if not (10 <= u < 630 and 10 <= v < 350):
            continue
        patch = gray[v - 10 : v + 11, u - 10 : u + 11].astype(float)
        weights = (patch > 60).astype(float)  # dots are brighter on top
        rows, columns = np.mgrid[-10:11, -10:11]
        centroid = np.array([np.sum(columns * weights), np.sum(rows * weights)]) / weights.sum()
        assert np.abs(centroid - (mark - (u, v))).max() < 0.8, name


def board_scene(board, pose: RigidTransform) -> Renderer:
    camera = small_camera()
    fixed = (board.shape(camera.world_from_camera @ pose),)
    sensor = CameraSensor(blur_px=0.5)
    return Renderer(white_scene(fixed=fixed, lighting=FLAT_LIGHT, sensor=sensor), "cam0")


def test_squares_cover_pixels_as_the_lens_says() -> None:
    board = Chessboard(square_mm=14.0, margin_mm=10.0)
    pose = RigidTransform.from_rotvec([0.2, -0.25, 0.1], [-60.0, -40.0, 400.0])
    drawn = board_scene(board, pose).radiance(0.0)[..., 0]
    intrinsics = small_camera().intrinsics
    corners = intrinsics.project(pose.apply(board.points))
    pixels = np.unique(np.rint(corners[:, None] + np.mgrid[-3:4, -3:4].reshape(2, -1).T), axis=1)
    pixels = pixels.reshape(-1, 2)[::5]
    inner = (np.arange(24) + 0.5) / 24 - 0.5
    offsets = np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    rays = intrinsics.unproject((pixels[:, None] + offsets).reshape(-1, 2))
    # Where the rays meet the board's plane, z = 0 of its frame.
    origin, along = pose.inverse().translation, rays @ pose.rotation
    xy = origin[:2] - along[:, :2] * (origin[2] / along[:, 2:])
    dark = (np.floor(xy / 14.0).sum(axis=1) % 2 == 0).reshape(len(pixels), -1).mean(axis=1)
    exact = 0.75 + (0.025 - 0.75) * dark
    u, v = pixels.astype(int).T
    error = (drawn[v, u] - exact) / 0.725
    assert len(pixels) > 400
    assert np.abs(error).max() < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.009
    assert abs(error.mean()) < 0.001


def test_charuco_corners_are_where_opencv_says() -> None:
    board = charuco((8, 5), 14.0, 10.0, "DICT_4X4_50")
    pose = RigidTransform.from_rotvec([0.1, 0.15, 0.05], [-60.0, -45.0, 350.0])
    gray = cv2.cvtColor(board_scene(board, pose).picture(0.0), cv2.COLOR_BGR2GRAY)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    reference = cv2.aruco.CharucoBoard((9, 6), 14.0, 10.0, words)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(reference).detectBoard(gray)
    assert len(ids) > 30
    points = reference.getChessboardCorners()[ids.ravel()]
    expected = small_camera().intrinsics.project(pose.apply(np.asarray(points, float)))
    assert np.abs(corners.reshape(-1, 2) - expected).mean() < 0.1

"""Boards that look the same after a turn, where it matters which way round they lie."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.calibration import Board, Capture, Chessboard, Corners, MarkerField
from measure.calibration.board_views import LENS_MODELS, fit_lens
from measure.calibration.capture import CaptureCamera, CaptureTable
from measure.calibration.common_views import fit_common_views
from measure.calibration.intrinsics import LensCalibration
from measure.calibration.starts import SeenBoard, oriented_board
from measure.calibration.views import ViewSet
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Camera
from tests.calibration.rigs import SIZE, cameras, lens, looking_at, markers


def _rig() -> list[Camera]:
    """Two upright cameras, and one upside down."""
    poses = [looking_at(np.array([x, -600.0, 40.0]), np.zeros(3)) for x in (-180.0, 0.0, 180.0)]
    poses[2] = poses[2] @ RigidTransform.from_rotvec(np.array([0, 0, np.pi]))
    return [Camera(f"cam{i}", lens(i), pose) for i, pose in enumerate(poses)]


def _turned_at_will(board: Board, seen: Camera, pose: RigidTransform, rng) -> Corners:
    """What a detector reports: corners numbered after any turn that shows the same pattern."""
    pixels = seen.project(pose.apply(board.points)) + rng.normal(0, 0.03, (len(board.points), 2))
    turn = board.turns[rng.integers(len(board.turns))]
    return Corners(np.arange(len(pixels)), pixels[turn], 0.4)


def _lenses(board: Board, tilt_deg: float, late: int = 0) -> dict[str, LensCalibration]:
    """Common views of a board that is turned about all axes, or about its normal alone."""
    rng, middle, poses = np.random.default_rng(3), board.points.mean(axis=0), []
    for _ in range(7):
        axis = rng.normal(size=3) * [1, 1, 0.3]
        turn = RigidTransform.from_rotvec(np.deg2rad(tilt_deg) * axis / np.linalg.norm(axis))
        facing = turn.rotation @ looking_at(np.array([0, -1.0, 0]), np.zeros(3)).rotation
        shift = rng.uniform(-30, 30, 3) * bool(tilt_deg)
        poses.append(RigidTransform(facing, shift - facing @ middle))
    found = {}
    for number, camera in enumerate(_rig()):
        shown = poses[late * number :] + poses[: late * number]
        views = tuple(
            replace(_turned_at_will(board, camera, pose, rng), source=f"{i}.png")
            for i, pose in enumerate(shown)
        )
        known = fit_lens(camera.intrinsics, board.points, views, LENS_MODELS[0])
        found[camera.name] = LensCalibration(
            known, LENS_MODELS[0], {}, (), ViewSet(SIZE, views, {})
        )
    return found


@pytest.mark.parametrize("corners", [(8, 6), (7, 5), (6, 6)])
def test_common_views_are_turned_until_they_agree(corners: tuple[int, int]) -> None:
    board = Chessboard(corners, 20.0)
    found, *_ = fit_common_views(board, _lenses(board, 25.0))
    true = _rig()
    for camera, wanted in zip(found, true, strict=True):
        pose = true[0].world_from_camera.inverse() @ wanted.world_from_camera
        delta = camera.world_from_camera.difference(pose)
        assert np.linalg.norm(delta[:3]) < 1.5
        assert np.linalg.norm(delta[3:]) < 0.003


def test_common_views_without_tilt_fit_two_ways_and_late_ones_none() -> None:
    even, odd = Chessboard((8, 6), 20.0), Chessboard((9, 6), 20.0)
    with pytest.raises(CalibrationError, match="9x7 squares looks the same after half"):
        fit_common_views(even, _lenses(even, 0.0))
    fit_common_views(odd, _lenses(odd, 0.0))
    for board in (even, odd):
        with pytest.raises(CalibrationError, match="of one number show one instant"):
            fit_common_views(board, _lenses(board, 25.0, late=1))


def _numbered(lens: LensCalibration, numbers: list[int]) -> LensCalibration:
    """The same pictures under other numbers; those without one are not there."""
    kept = zip(lens.views.views, numbers, strict=False)
    views = tuple(replace(view, source=f"{number}.png") for view, number in kept)
    return replace(lens, views=ViewSet(SIZE, views, {}))


@pytest.mark.parametrize(
    ("first", "said"),
    [
        (1, "used as the one before it: another camera lost 1 at the beginning"),
        (-2, "used as the one 2 numbers after it: it lost 2 at the beginning"),
    ],
)
def test_numbers_of_common_views_that_are_off_are_named(first: int, said: str) -> None:
    board = Chessboard((9, 6), 20.0)
    lenses = _lenses(board, 25.0)
    off = {n: _numbered(lens, list(range(10, 17))) for n, lens in lenses.items()}
    off["cam1"] = _numbered(lenses["cam1"], list(range(10 + first, 17 + first)))
    with pytest.raises(CalibrationError, match=f"camera cam1: .*of one number show one.*{said}"):
        fit_common_views(board, off)
    mixed = off | {"cam1": _numbered(lenses["cam1"], [13, 10, 16, 12, 15, 11, 14])}
    with pytest.raises(CalibrationError, match=r"of one number show one instant\?$"):
        fit_common_views(board, mixed)


def test_cameras_that_see_the_board_in_two_groups_are_named() -> None:
    board = Chessboard((9, 6), 20.0)
    lenses = _lenses(board, 25.0)
    lenses["cam3"] = lenses["cam1"]
    for name in ("cam2", "cam3"):
        lenses[name] = _numbered(lenses[name], list(range(6, 13)))
    said = r"cam0 and cam1 share views, and so do cam2 and cam3, but a camera .* shares 1 with"
    with pytest.raises(CalibrationError, match=said):
        fit_common_views(board, lenses)
    del lenses["cam3"]
    with pytest.raises(CalibrationError, match="camera cam2: shares 1 board views with the other"):
        fit_common_views(board, lenses)


@pytest.mark.parametrize("corners", [(6, 6)])
def test_a_board_of_known_pose_lies_where_the_marks_agree(corners: tuple[int, int]) -> None:
    board, true = Chessboard(corners, 25.0), cameras()[0]
    facing = looking_at(true.center, np.array([0.0, 0.0, 250.0]))
    pose = RigidTransform(facing.rotation, facing.apply([-80.0, -60.0, 300.0]))
    field = MarkerField(tuple(f"m{i}" for i in range(16)), markers())
    marks = dict(zip(field.names[:4], true.project(field.points[:4]), strict=True))
    plain = CaptureCamera(name="cam0", calibration="lens.toml")
    without = Capture(Path(), CaptureTable(name="bench"), board, field, ())
    with_marks = replace(without, marks={"cam0": marks})
    origin = true.project(pose.apply(board.points[:1]))[0]
    said = plain.model_copy(update={"board_origin_px": tuple(origin + 20)})
    for turn in board.turns:
        pixels = true.project(pose.apply(board.points))[turn]
        seen = SeenBoard(board, Corners(np.arange(len(pixels)), pixels, 0.4, "board.jpg"), pose)
        for camera, capture in ((plain, with_marks), (said, without)):
            lies = oriented_board(camera, true.intrinsics, seen, capture).corners
            assert np.allclose(lies.pixels[np.argmin(lies.ids)], origin)
        place = rf"board_origin_px = .*\[{origin[0]:.0f}, {origin[1]:.0f}\]"
        with pytest.raises(CalibrationError, match=place):
            oriented_board(plain, true.intrinsics, seen, without)


@pytest.mark.parametrize(("corners", "ways"), [((7, 5), 2), ((6, 6), 4), ((5, 5), 2), ((6, 5), 1)])
def test_pictures_that_look_the_same_have_as_many_turns(corners, ways: int) -> None:
    columns, rows = corners
    squares = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 * 215 + 20
    picture = cv2.copyMakeBorder(
        np.kron(squares, np.ones((30, 30))).astype(np.uint8), 30, 30, 30, 30, 0, value=235
    )
    board = Chessboard(corners, 25.0)
    assert len(board.turns) == ways
    turns = (np.rot90(picture, k) for k in range(4))
    origins = set()
    for quarter, turned in enumerate(turns):
        found = board.find(np.ascontiguousarray(turned))
        height, width = turned.shape
        there = np.array([[[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]]])
        corner = int(np.argmin(np.linalg.norm(there[0] - found.pixels[0], axis=1)))
        origins.add((corner + quarter) % 4)
    assert len(origins) <= ways

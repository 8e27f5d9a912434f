"""Boards whose markers carry numbers: AprilGrids, and ChArUco boards described wrongly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.arrays import Bytes
from measure.calibration import Charuco, Chessboard, calibrate_lens, find_views, read_board
from measure.calibration.boards import AprilGrid
from measure.calibration.other_boards import other_board, tag_gap
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from tests.calibration.rigs import SIZE, lens

TRUE = Charuco((4, 7), 30.0, 22.0, "DICT_4X4_50", legacy=True)


def _print(board: Charuco) -> Bytes:
    columns, rows = board.squares
    flat = np.asarray(board.pattern.generateImage((40 * columns, 40 * rows), marginSize=0))
    flat = cv2.copyMakeBorder(flat, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    return np.asarray(255 - flat if board.inverted else flat, np.uint8)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"legacy": False}, "markers lie as OpenCV before 4.6 draws them: write legacy = true$"),
        (
            {"inner_corners": (8, 5), "dictionary": "DICT_6X6_250", "inverted": True},
            r'write inner_corners = \[4, 7\], dictionary = "DICT_4X4_50", inverted = false$',
        ),
        (
            {"inner_corners": (5, 5)},
            r"5x8 squares seen, 6x6 chosen: write inner_corners = \[4, 7\]$",
        ),
    ],
)
def test_a_charuco_board_described_wrongly(wrong: dict[str, object], said: str) -> None:
    picture = cv2.cvtColor(_print(TRUE), cv2.COLOR_GRAY2BGR)
    pictures = [("0.png", np.asarray(picture, np.uint8))]
    with pytest.raises(CalibrationError, match=rf"no board found in any of 1 pictures; .*{said}"):
        find_views(replace(TRUE, **wrong), pictures, "cam0")


def test_a_board_whose_numbers_do_not_begin_at_0() -> None:
    true = Charuco((8, 5), 30.0, 22.0, "DICT_4X4_250", first_marker=27)
    picture = _print(true)
    found = true.find(picture)
    assert found is not None
    assert len(found.ids) == 40
    other = other_board(replace(true, first_marker=0), [picture])
    assert other is not None
    assert other.board == true
    assert other.remedy == "write first_marker = 27"
    whole = replace(true, first_marker=0)
    part = _print(whole)[80:]  # without its uppermost row it is no board of other numbers
    assert other_board(replace(whole, inner_corners=(5, 8)), [part]).board == whole


def _before_a_wall(near: Bytes, far: Bytes) -> Bytes:
    """A board, and a smaller print of it beside."""
    height, width = near.shape
    out = np.full((height, width + far.shape[1]), 255, np.uint8)
    out[:, :width] = near
    out[: far.shape[0], width:] = far
    return out


def test_of_two_copies_the_nearer_one_is_taken() -> None:
    near = _print(TRUE)
    far = cv2.resize(near, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    alone, found = TRUE.find(near), TRUE.find(_before_a_wall(near, far))
    assert alone is not None
    assert found is not None
    assert found.twice
    assert not alone.twice
    np.testing.assert_array_equal(found.ids, alone.ids)
    np.testing.assert_allclose(found.pixels, alone.pixels, atol=0.1)
    alike = np.asarray(cv2.cvtColor(_before_a_wall(near, near), cv2.COLOR_GRAY2BGR), np.uint8)
    with pytest.raises(CalibrationError, match="its markers are seen twice"):
        find_views(TRUE, [("0.png", alike)], "cam0")


def _chessboard(columns: int, rows: int) -> Bytes:
    cells = np.indices((rows, columns)).sum(axis=0) % 2 * 255
    flat = np.kron(cells, np.ones((40, 40))).astype(np.uint8)
    return cv2.copyMakeBorder(flat, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)


def test_another_board_than_the_chosen_one_is_named() -> None:
    smaller = replace(TRUE, inner_corners=(8, 5))
    seen = [
        (smaller, _print(TRUE), "5x8 squares seen, 9x6 chosen"),
        (TRUE, _chessboard(10, 7), "a chessboard of 10x7 squares seen, a ChArUco board"),
        (Chessboard((8, 5), 25.0), _chessboard(10, 7), "10x7 squares seen, 9x6 chosen"),
        (Chessboard((8, 5), 25.0), _print(TRUE), "a ChArUco board of 5x8 squares (DICT_4X4"),
        (AprilGrid((6, 6), 40.0, 0.3), _print(TRUE), "a ChArUco board of 5x8 squares (DICT"),
    ]
    for chosen, picture, said in seen:
        other = other_board(chosen, [picture])
        assert other is not None
        assert other.text.startswith(f"this is another board: {said}")
        if other.board is not None:  # It is the one to take
            assert other.board.find(picture) is not None
    assert other_board(TRUE, [np.full((200, 300), 200, np.uint8)]) is None


def test_a_gap_between_tags_in_another_unit_is_named() -> None:
    views = [GRID.find(_grid(GRID, 2, 0))]
    pictures = [("0.png", np.repeat(_grid(GRID, 2, 0)[:, :, None], 3, axis=2))] * 2
    assert tag_gap(GRID, [(view.ids, view.pixels) for view in views]) == ""
    in_metres = replace(GRID, tag_spacing=0.012)
    with pytest.raises(CalibrationError, match=r"0\.012, is that ratio, no .*tag_spacing = 0\.3"):
        find_views(in_metres, pictures, "cam0")


def test_an_upright_picture_among_lying_ones_is_named() -> None:
    lying = np.repeat(_print(TRUE)[:, :, None], 3, axis=2)
    pictures = [("0.png", lying), ("1.png", np.ascontiguousarray(np.rot90(lying)))]
    with pytest.raises(CalibrationError, match=r"1\.png is .* turned by a quarter\? Turn it back"):
        find_views(TRUE, pictures, "cam0")


def test_pictures_without_markers_say_nothing_of_the_board() -> None:
    blank = np.full((200, 300, 3), 200, np.uint8)
    with pytest.raises(CalibrationError, match=r"check that board\.toml describes the printed"):
        find_views(TRUE, [("0.png", blank)], "cam0")


def _grid(board: AprilGrid, border: int, turn: int) -> Bytes:
    """The printed grid at a px a mm, white around; its tags turned as some printers do."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    px, gap = 40, 12
    columns, rows = board.tags
    flat = np.full((rows * (px + gap) + gap, columns * (px + gap) + gap), 255, np.uint8)
    for row in range(rows + 1):
        for column in range(columns + 1):
            y, x = row * (px + gap), column * (px + gap)
            flat[y : y + gap, x : x + gap] = 0
            if row < rows and column < columns:
                number = (rows - 1 - row) * columns + column
                tag = dictionary.generateImageMarker(number, px, borderBits=border)
                flat[y + gap : y + gap + px, x + gap : x + gap + px] = np.rot90(tag, turn)
    return cv2.copyMakeBorder(flat, gap, gap, gap, gap, cv2.BORDER_CONSTANT, value=255)


GRID = AprilGrid((5, 4), 40.0, 0.3)
"""Drawn at a px a mm, its first corner 24 px from the left and from the top."""


@pytest.mark.parametrize(("border", "turn"), [(2, 2), (2, 0), (1, 1)])
def test_tags_are_numbered_however_they_were_printed(border: int, turn: int) -> None:
    found = GRID.find(_grid(GRID, border, turn))
    assert len(found.ids) == len(GRID.points)
    np.testing.assert_allclose(found.pixels, GRID.points[found.ids, :2] + 23.5, atol=0.3)


def test_a_lens_is_calibrated_by_an_aprilgrid_of_which_parts_are_seen() -> None:
    board, true, rng = GRID, lens(0), np.random.default_rng(5)
    straight = replace(true, distortion=np.zeros(5))
    flat = _grid(board, 2, 2)
    to_mm = np.array([[1, 0, -23.5], [0, 1, -23.5], [0, 0, 1]])
    pictures = []
    for number in range(7):
        axis = rng.normal(size=3) * [1, 1, 0.3]
        turned = RigidTransform.from_rotvec(np.deg2rad(30) * axis / np.linalg.norm(axis)).rotation
        off = np.array([60 * (number % 3 - 1), 40 * (number // 3 - 1), 480])
        shift = off - turned @ [125, 100, 0]
        H = straight.matrix @ np.column_stack([turned[:, :2], shift]) @ to_mm
        picture = cv2.warpPerspective(flat, H, SIZE, flags=cv2.INTER_AREA, borderValue=200)
        picture = cv2.cvtColor(cv2.GaussianBlur(picture, (0, 0), 0.7), cv2.COLOR_GRAY2BGR)
        pictures.append((f"{number}.png", np.asarray(picture, np.uint8)))
    views = find_views(board, pictures, "cam0")
    assert len(views.views) == 7
    assert min(len(view.ids) for view in views.views) < len(board.points)
    found = calibrate_lens(board, views, "cam0")
    assert found.fit.rms_px < 0.15
    focal = found.intrinsics.matrix[[0, 1], [0, 1]]
    np.testing.assert_allclose(focal, straight.matrix[[0, 1], [0, 1]], rtol=3e-3)


def test_kalibrs_target_files(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    text = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 4\ntagSize: 0.088\ntagSpacing: 0.3\n"
    path.write_text(text)
    grid = read_board(path)
    assert grid == AprilGrid((6, 4), 88.0, 0.3)
    # Kalibr's corner 0 is the lower left one of the first tag, at the lower left of the grid.
    assert np.max(grid.points[:, 1]) == grid.points[2, 1]
    own = tmp_path / "board.toml"
    own.write_text('kind = "aprilgrid"\ntags = [6, 4]\ntag_mm = 88.0\ntag_spacing = 0.3\n')
    assert read_board(own) == grid
    path.write_text(
        "target_type: checkerboard\ntargetCols: 9\ntargetRows: 6\n"
        "rowSpacingMeters: 0.025\ncolSpacingMeters: 0.025\n"
    )
    np.testing.assert_allclose(np.ptp(read_board(path).points, axis=0), [200, 125, 0])
    for wrong, said in (
        (text.replace("tagRows: 4", ""), "not a target as Kalibr writes it: 'tagRows'"),
        (text.replace("Rows: 4", "Rows: 99"), "6x99 tags: the family 36h11 has 587"),
        (text.replace("aprilgrid", "circlegrid"), "type 'circlegrid' is not read"),
        ("a: [", "not a target as Kalibr writes it"),
    ):
        path.write_text(wrong)
        with pytest.raises(CalibrationError, match=rf"target\.yaml: .*{said}"):
            read_board(path)

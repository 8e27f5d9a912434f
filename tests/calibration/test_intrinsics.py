from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from measure.calibration import Chessboard, Corners, calibrate_lens, choose_views, read_board
from measure.calibration.board_views import LENS_MODELS, fit_lens, start_intrinsics
from measure.calibration.findings import lens_findings
from measure.calibration.intrinsics import _shaped, board_shape
from measure.calibration.views import ViewSet
from measure.errors import CalibrationError
from measure.geometry import RigidTransform
from measure.model import Intrinsics
from tests.calibration.rigs import BOARD, SIZE, board_views, lens


def test_matches_opencv_to_its_digits() -> None:
    views = board_views(lens(0), np.random.default_rng(3))
    start = start_intrinsics(SIZE, BOARD.points, views)
    ours = fit_lens(start, BOARD.points, views, LENS_MODELS[4])
    points = [BOARD.points.astype(np.float32)] * len(views)
    pixels = [v.pixels.astype(np.float32) for v in views]
    rms, matrix, _, _, _ = cv2.calibrateCamera(points, pixels, SIZE, None, None)
    assert ours.rms_px == pytest.approx(rms, rel=1e-4)
    np.testing.assert_allclose(ours.intrinsics.matrix, matrix, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("bow_px", [0.0, 0.3])
def test_the_covariance_is_the_scatter(bow_px) -> None:
    """Of corners that err one by one, and of views whose boards are bent, each another way."""
    true, model, free = lens(1), LENS_MODELS[3], list(LENS_MODELS[3].free)
    across = BOARD.points[:, :1] - BOARD.points[:, 0].mean()
    bow = bow_px * (across / np.ptp(across) * 2) ** 2
    squares, one_by_one = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        flat = board_views(true, rng)
        views = tuple(replace(v, pixels=v.pixels + bow * rng.normal(size=2)) for v in flat)
        plain, fit = (
            fit_lens(start_intrinsics(SIZE, BOARD.points, some), BOARD.points, some, model)
            for some in (flat, views)
        )
        error = (fit.intrinsics.vector - true.vector)[free]
        for out, P in (
            (squares, fit.intrinsics.covariance),
            (one_by_one, plain.intrinsics.covariance * (fit.sd_px / plain.sd_px) ** 2),
        ):
            out.append(error @ np.linalg.solve(P[np.ix_(free, free)], error) / len(error))
    # The mean of 25 chi-squared / 8 has a standard deviation of 0.1.
    assert 0.7 < np.mean(squares) < 1.35
    assert (np.mean(one_by_one) > 5) == (bow_px > 0), "as if corners erred one by one"


def test_unsupported_lens_freedom_is_refused_with_a_reason() -> None:
    views = board_views(lens(0), np.random.default_rng(5))
    found = calibrate_lens(BOARD, choose_views(BOARD, list(views), SIZE, "cam0"), "cam0")
    assert found.model.name == "tangential"
    assert any("brown refused: k3" in reason for reason in found.reasons)
    views = board_views(Intrinsics(SIZE, lens(0).matrix), np.random.default_rng(6))
    found = calibrate_lens(BOARD, choose_views(BOARD, list(views), SIZE, "cam0"), "cam0")
    assert found.model.name == "pinhole"
    assert any("tangential refused" in reason for reason in found.reasons)


def test_repeats_to_the_last_digit() -> None:
    views = board_views(lens(0), np.random.default_rng(7), count=8)
    chosen = choose_views(BOARD, list(views), SIZE, "cam0")
    first, second = (calibrate_lens(BOARD, chosen, "cam0").intrinsics for _ in range(2))
    assert np.array_equal(first.vector, second.vector)


def test_a_view_with_wrong_corners_is_left_out_and_named() -> None:
    views = list(board_views(lens(0), np.random.default_rng(8)))
    views[4] = replace(views[4], pixels=np.roll(views[4].pixels, 9, axis=0))
    found = calibrate_lens(BOARD, choose_views(BOARD, views, SIZE, "cam0"), "cam0")
    assert "view4.jpg" in found.views.left_out
    assert abs(found.intrinsics.focal_px - lens(0).focal_px) < 2


def test_badly_localised_corners_of_slanted_views_are_left_out_alone() -> None:
    """Three of seven views were left out for them, and what remained was refused."""
    views = list(board_views(lens(0), np.random.default_rng(8), count=7))
    for number in (1, 3, 5):
        pixels = views[number].pixels.copy()
        pixels[:6] += np.random.default_rng(number).normal(0, 0.9, (6, 2))
        views[number] = replace(views[number], pixels=pixels)
    found = calibrate_lens(BOARD, choose_views(BOARD, views, SIZE, "cam0"), "cam0")
    assert found.views.left_out == {}
    counts = [len(BOARD.points) - len(view.ids) for view in found.views.views]
    assert all(3 <= counts[number] <= 7 for number in (1, 3, 5)), counts
    assert all(counts[number] <= 1 for number in (0, 2, 4, 6)), counts
    assert abs(found.intrinsics.focal_px - lens(0).focal_px) < 3


def test_too_few_views_are_refused() -> None:
    views = board_views(lens(0), np.random.default_rng(0), count=4)
    with pytest.raises(CalibrationError, match="4 different sharp views"):
        choose_views(BOARD, list(views), SIZE, "cam0")


def test_views_all_alike_are_refused() -> None:
    rng = np.random.default_rng(0)
    view = board_views(lens(0), rng, count=1)[0]
    alike = [replace(view, pixels=view.pixels + rng.normal(0, 1, 2)) for _ in range(20)]
    with pytest.raises(CalibrationError, match=r"1 different sharp views.*19 more are all alike"):
        choose_views(BOARD, alike, SIZE, "cam0")


def test_views_without_tilt_leave_the_focal_length_open() -> None:
    views = []
    for number in range(6):
        shift = [number % 3 * 70.0 - 160, number // 3 * 40.0 - 100, 500.0]
        pixels = lens(0).project(BOARD.points + shift)
        noise = np.random.default_rng(number).normal(0, 0.05, pixels.shape)
        views.append(Corners(np.arange(len(pixels)), pixels + noise, 0.4, f"{number}.jpg"))
    chosen = choose_views(BOARD, views, SIZE, "cam0")
    with pytest.raises(CalibrationError, match=r"focal length|undetermined|settle"):
        calibrate_lens(BOARD, chosen, "cam0")


def test_blurred_views_are_left_out() -> None:
    views = list(board_views(lens(0), np.random.default_rng(2)))
    views[3] = replace(views[3], sharpness=0.05)
    chosen = choose_views(BOARD, views, SIZE, "cam0")
    assert "blurred" in chosen.left_out["view3.jpg"]
    assert chosen.coverage().sum() == 54 * 11


FISHEYE = Intrinsics(
    SIZE,
    np.array([[700.0, 0, 648], [0, 701, 352], [0, 0, 1]]),
    np.array([-0.03, 0.006, 0, 0]),
    model="fisheye",
)
"""105 degrees wide, 120 from corner to corner."""
SMALL_BOARD = Chessboard((6, 5), 25.0)


def wide_views(lens: Intrinsics) -> ViewSet:
    """A small board all over the picture, up to 60 degrees off the axis."""
    rng, views = np.random.default_rng(4), []
    for u, v in [(u, v) for u in (110, 640, 1170) for v in (100, 360, 620)]:
        (ray,) = lens.unproject([[u, v]])
        facing = RigidTransform.from_rotvec(np.arccos(ray[2]) * np.array([-ray[1], ray[0], 0]))
        tilt = RigidTransform.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        turn = (facing @ tilt).rotation
        place = RigidTransform(turn, 210 * ray - turn @ SMALL_BOARD.points.mean(axis=0))
        pixels = lens.project(place.apply(SMALL_BOARD.points))
        pixels += rng.normal(0, 0.05, pixels.shape)
        views.append(Corners(np.arange(len(pixels)), pixels, 0.4, f"view{len(views)}.jpg"))
    return choose_views(SMALL_BOARD, views, SIZE, "cam0")


def test_a_fisheye_is_found_where_it_is_asked_for_and_advised_where_not() -> None:
    views = wide_views(FISHEYE)
    found = calibrate_lens(SMALL_BOARD, views, "cam0", "fisheye")
    lens, P = found.intrinsics, found.intrinsics.covariance
    assert lens.model == "fisheye"
    assert "fx fy cx cy k1 k2" in found.model.parameters
    assert found.fit.rms_px < 0.08
    free = list(found.model.free)
    off = (lens.vector - FISHEYE.vector)[free]
    assert off @ np.linalg.solve(P[np.ix_(free, free)], off) < 26.1  # chi-squared of 8, 99.9 %
    advice = 'a fisheye fits the views to 0.07 px: say model = "fisheye"'
    with pytest.raises(CalibrationError, match=advice):
        calibrate_lens(SMALL_BOARD, views, "cam0")


def test_no_fisheye_is_advised_for_a_wide_pinhole() -> None:
    wide = Intrinsics(SIZE, np.array([[640.0, 0, 648], [0, 641, 352], [0, 0, 1]]))
    found = calibrate_lens(SMALL_BOARD, wide_views(wide), "cam0")
    assert not any("fisheye" in reason for reason in found.reasons)


def test_notes_of_one_kind_are_one_line() -> None:
    left_out = dict.fromkeys([f"{k:02d}.jpg" for k in range(26)], ("no board found", ""))
    left_out |= {"30.jpg": ("blurred", "1.00, 4"), "31.jpg": ("blurred", "2.00, 4")}
    left_out["40.jpg"] = "the same as another view", ""
    left_out["50.jpg"] = "its corners miss", "by 9 px"
    views = SimpleNamespace(covered_share=1.0, mirrored=0, left_out=left_out, views=())
    lens = SimpleNamespace(views=views, reasons=())
    assert [str(found) for found in lens_findings(SimpleNamespace(lenses={"cam0": lens}))] == [
        "note: camera cam0: 26 pictures left out, no board found; first 00.jpg",
        "note: camera cam0: 2 pictures left out, blurred; first 30.jpg",
        "note: camera cam0: 40.jpg left out: the same as another view",
        "note: camera cam0: 50.jpg left out: its corners miss (by 9 px)",
    ]


@pytest.mark.parametrize("shape", [(0, 0, 0), (-0.016, 0, 0), (0, 0, -0.6), (0.003, 0.8, 0)])
def test_a_stretched_board_and_a_bowed_one_are_told_apart(shape) -> None:
    """And from the lens; a right one is neither."""
    printed = SimpleNamespace(points=_shaped(BOARD.points, np.array(shape)))
    found = []
    for number in range(3):
        views = board_views(lens(number), np.random.default_rng(number), board=printed)
        found.append(calibrate_lens(BOARD, choose_views(BOARD, list(views), SIZE, "cam0"), "cam0"))
    measured = board_shape(BOARD, found)
    off = np.abs(measured.values - shape)
    assert np.all(off < np.maximum(4 * measured.sds, 0.05 * np.abs(shape)))
    assert np.all(measured.sds < [5e-4, 0.06, 0.06])
    np.testing.assert_array_equal(measured.seen != 0, np.array(shape) != 0)


def test_a_board_file_states_both_sides_of_a_square(tmp_path) -> None:
    (tmp_path / "board.toml").write_text(
        'kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = [25.0, 24.6]\n', "utf-8"
    )
    points = read_board(tmp_path / "board.toml").points
    np.testing.assert_allclose(points, BOARD.points * [1, 24.6 / 25, 1])

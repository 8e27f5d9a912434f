"""Printed targets, rasterised and measured: every corner is there, at the true scale."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest

from measure.api import draw_target, shipped_targets
from measure.arrays import Bytes
from measure.calibration import read_board
from measure.calibration.printing import BAR_MM, Sheet
from measure.calibration.targets import read_markers
from measure.errors import CalibrationError, ConfigError
from measure.session import read_body
from tests.chromium import Chromium

TARGETS = Path(__file__).parents[2] / "calibration_targets"
PX_PER_MM = 200 / 25.4


def rasterised(target: str, folder: Path) -> tuple[Sheet, Bytes]:
    sheet, path = draw_target(TARGETS / target, folder / "target.pdf")
    with pypdfium2.PdfDocument(path) as document:
        page = document[0]
        bitmap = page.render(scale=PX_PER_MM / 72 * 25.4)
        pixels = np.array(bitmap.to_numpy()[:, :, :3])
        bitmap.close()
        page.close()
    return sheet, np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


KALIBR = """\
target_type: 'aprilgrid' #gridtype
tagCols: 5
tagRows: 4
tagSize: 0.028
tagSpacing: 0.3
"""


@pytest.mark.parametrize("name", ["chessboard_9x6_25.toml", "charuco_8x5_27.toml", "grid.yaml"])
def test_every_corner_is_found_again_at_its_place(name: str, tmp_path: Path) -> None:
    path = TARGETS / name
    if path.suffix == ".yaml":
        path = tmp_path / name
        path.write_text(KALIBR)
    sheet, gray = rasterised(str(path), tmp_path)
    board = read_board(path)
    found = board.find(gray)
    assert len(found.ids) == len(board.points)
    # The frame's origin is the first inner corner; Charuco counts from the outer corner.
    first = board.points[found.ids] - board.points.min(axis=0)
    places = (found.pixels + 0.5) / PX_PER_MM
    np.testing.assert_allclose(places, first[:, :2] + sheet.origin_mm, atol=0.1)
    scale = np.linalg.norm(np.ptp(places, axis=0)) / np.linalg.norm(np.ptp(first[:, :2], axis=0))
    assert scale == pytest.approx(1, abs=1e-3)  # the page is rounded to whole pixels


def test_the_scale_bar_measures_100_mm(tmp_path: Path) -> None:
    sheet, gray = rasterised("chessboard_9x6_25.toml", tmp_path)
    row = gray[round((sheet.size_mm[1] - 8.0) * PX_PER_MM)]
    dark = np.flatnonzero(row[: round(112 * PX_PER_MM)] < 200)
    assert (dark.max() - dark.min() + 1) / PX_PER_MM == pytest.approx(BAR_MM, abs=0.3)


def test_marker_dots_stand_where_the_file_says(tmp_path: Path) -> None:
    sheet, gray = rasterised("raven_markers_16.toml", tmp_path)
    places = np.unique(read_markers(TARGETS / "raven_markers_16.toml").points[:, :2], axis=0)
    _, labels, stats, centroids = cv2.connectedComponentsWithStats((gray < 128).astype(np.uint8))
    assert labels.max() >= len(places)
    for x, y in places:
        wanted = np.array([sheet.origin_mm[0] + x, sheet.origin_mm[1] - y])
        offsets = np.linalg.norm((centroids + 0.5) / PX_PER_MM - wanted, axis=1)
        nearest = int(np.argmin(offsets))
        assert offsets[nearest] < 0.15
        assert stats[nearest, cv2.CC_STAT_AREA] > 12 * PX_PER_MM**2


def test_svg_is_in_millimetres_and_says_the_same(tmp_path: Path) -> None:
    sheet, path = draw_target(TARGETS / "chessboard_9x6_25.toml", tmp_path / "board.svg")
    root = ET.parse(path).getroot()
    assert root.get("width") == f"{sheet.size_mm[0]:g}mm"
    assert root.get("viewBox") == f"0 0 {sheet.size_mm[0]:g} {sheet.size_mm[1]:g}"
    squares = [e for e in root.iter() if e.get("width") == "25.0000"]
    assert len(squares) == 35
    corner = (float(squares[0].get("x", 0)) + 25, float(squares[0].get("y", 0)) + 25)
    assert corner == pytest.approx(sheet.origin_mm, abs=1e-3)


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.parametrize("name", ["charuco_8x5_27.toml"])
def test_a_browser_draws_every_corner_of_the_svg_at_its_place(name: str, tmp_path: Path) -> None:
    sheet, path = draw_target(TARGETS / name, tmp_path / "board.svg")
    shown = tmp_path / "shown.html"
    shown.write_text(f'<body style="margin:0"><img src="{path.name}"></body>')
    with Chromium(1300, 900) as page:
        page.open(shown.as_uri())
        page.wait_for("document.readyState == 'complete' && document.images[0].complete", 60)
        picture = page.screenshot()
    gray = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    board = read_board(TARGETS / name)
    found = board.find(np.asarray(gray, np.uint8))
    assert len(found.ids) == len(board.points)
    first = board.points[found.ids] - board.points.min(axis=0)
    places = (found.pixels + 0.5) / 96 * 25.4  # CSS: 96 px an inch
    np.testing.assert_allclose(places, first[:, :2] + sheet.origin_mm, atol=0.3)


def test_the_papers_body_is_drawn_and_true(tmp_path: Path) -> None:
    body = read_body(TARGETS / "raven_three_ball.toml")
    np.testing.assert_array_equal(body.centers, [[38, 0, 0], [0, 38, 0], [-38, 0, 0]])
    sheet, path = draw_target(TARGETS / "raven_three_ball.toml", tmp_path / "body.svg")
    circles = [e for e in ET.parse(path).getroot().iter() if e.tag.endswith("circle")]
    assert [float(c.get("r", 0)) for c in circles] == [20, 20, 20]
    assert float(circles[0].get("cx", 0)) == pytest.approx(sheet.origin_mm[0] + 38)


@pytest.mark.parametrize("name", ["raven_three_ball.toml", "raven_markers_16.toml", "long.toml"])
def test_no_text_leaves_the_page(tmp_path: Path, name: str) -> None:
    text = (TARGETS / "raven_three_ball.toml").read_text()
    (tmp_path / "long.toml").write_text(text.replace('name = "raven', f'name = "{34 * "long "}', 1))
    file = tmp_path / name if name == "long.toml" else TARGETS / name
    sheet, path = draw_target(file, tmp_path / "target.pdf")
    with pypdfium2.PdfDocument(path) as document:
        page = document[0].get_textpage()
        boxes = np.array([page.get_charbox(n) for n in range(page.count_chars())])
        page.close()
    assert len(boxes) > 100
    assert boxes.min() > 0
    assert np.all(boxes.max(axis=0)[2:] < np.array(sheet.size_mm) * 72 / 25.4)


def test_a_marker_field_far_from_the_origin_says_where_it_is(tmp_path: Path) -> None:
    text = (TARGETS / "raven_markers_16.toml").read_text()
    far = tmp_path / "far.toml"
    far.write_text(text.replace("[127.0, ", "[627.0, ").replace("[-127.0, ", "[373.0, "))
    far.write_text(far.read_text().replace("[0.0, ", "[500.0, "))
    _, path = draw_target(far, tmp_path / "far.svg")
    assert "x right, y up; m00 stands at x = 627, y = 127 mm" in path.read_text()
    assert "world origin" not in path.read_text()


def test_markers_of_one_name_are_not_drawn(tmp_path: Path) -> None:
    text = (TARGETS / "raven_markers_16.toml").read_text()
    (tmp_path / "twice.toml").write_text(text.replace('"m01"', '"m00"'))
    with pytest.raises(CalibrationError, match="marker 'm00' is there 2 times"):
        draw_target(tmp_path / "twice.toml", tmp_path / "twice.svg")


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        (
            r"inner_corners = .*",
            "inner_corners = [20, 20]",
            "the board needs 220 markers, .* holds",
        ),
        (r"marker_mm = .*", "marker_mm = 26.9999999999", "marker_mm must be smaller"),
    ],
)
def test_charuco_boards_that_opencv_cannot_make(tmp_path, right, wrong, said) -> None:
    text = (TARGETS / "charuco_8x5_27.toml").read_text()
    (tmp_path / "board.toml").write_text(re.sub(right, wrong, text))
    with pytest.raises(CalibrationError, match=said):
        read_board(tmp_path / "board.toml")


def test_other_endings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.pdf or \.svg"):
        draw_target(TARGETS / "raven_three_ball.toml", tmp_path / "body.png")


def test_a_tolerance_finer_than_any_measurement(tmp_path):
    """The joint fit of a rig would end in numbers that are none."""
    text = (TARGETS / "raven_markers_16.toml").read_text()
    field = tmp_path / "markers.toml"
    for tolerance, stands in (("0", True), ("1e-6", True), ("1e-300", False), ("-1", False)):
        field.write_text(text.replace("tolerance_mm = 0.1", f"tolerance_mm = {tolerance}"))
        if stands:
            assert read_markers(field).tolerance_mm == float(tolerance)
        else:
            with pytest.raises(CalibrationError, match=r"markers.toml:\d+: 'tolerance_mm'"):
                read_markers(field)


def test_shipped_targets_are_drawn_by_name(tmp_path: Path) -> None:
    assert set(shipped_targets()) == {path.stem for path in TARGETS.glob("*.toml")}
    by_path = draw_target(TARGETS / "chessboard_9x6_25.toml", tmp_path / "path.svg")[1]
    for name in ("chessboard_9x6_25.toml", "chessboard_9x6_25"):
        by_name = draw_target(name, tmp_path / f"{name}.svg")[1]
        assert by_name.read_bytes() == by_path.read_bytes()


def test_a_file_comes_before_a_shipped_target(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    mine = (TARGETS / "raven_three_ball.toml").read_text()
    Path("chessboard_9x6_25.toml").write_text(mine)
    assert "RAVEN" in draw_target("chessboard_9x6_25.toml", "mine.svg")[1].read_text().upper()


def test_an_unknown_target_names_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"chessbord: neither a file nor .* chessboard_9x6_25"):
        draw_target("chessbord", tmp_path / "board.svg")

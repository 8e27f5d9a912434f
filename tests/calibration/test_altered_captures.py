"""Real pictures, altered: each mistake is refused or reported, each optional part may go."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from measure import api
from measure.cli import main
from measure.errors import CalibrationError
from measure.session import read_calibration
from tests.calibration.altered import MIDDLE, AlteredCapture, cost_mm, mirrored, turned, zoomed
from tests.calibration.test_crosses import picture

MIXED = {"m02": "m03", "m03": "m04", "m04": "m02", "m10": "m11", "m11": "m10"}


@pytest.fixture
def altered(renders: Path, tmp_path: Path) -> Callable[..., AlteredCapture]:
    source = renders / "E_calibration"
    return lambda *cameras: AlteredCapture(source, tmp_path / "capture", cameras)


def refusal(capture: AlteredCapture, capsys: pytest.CaptureFixture[str], *more: str) -> str:
    """The one line with which the command refuses; it writes nothing."""
    output = capture.folder / "calibration.toml"
    assert main(["calibrate", str(capture.folder), "-o", str(output), *more]) == 2
    _, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if not line.startswith("calibrating:")]
    assert len(lines) == 1, err
    assert not output.exists()
    return lines[0]


def written(capture: AlteredCapture, *more: str) -> dict[str, Any]:
    """The judgement in the file that the command writes."""
    output = capture.folder / "calibration.toml"
    code = main(["calibrate", str(capture.folder), "-o", str(output), *more])
    judgement: dict[str, Any] = tomllib.loads(output.read_text())["provenance"]["judgement"]
    assert code == (0 if judgement["trustworthy"] else 3)
    return judgement


# --- other programs' files ---


def test_foreign_files_are_written_and_known_lenses_read(altered) -> None:
    capture, form, name = altered("cam0", "cam2"), "anipose", "c.toml"
    output, foreign = capture.folder / "calibration.toml", capture.folder / name
    assert main(["calibrate", str(capture.folder), "-o", str(output)]) == 0
    said = ["-o", str(foreign), "--format", form, "--report", str(capture.folder / "r.html")]
    assert main(["calibrate", str(capture.folder), *said]) == 0
    ours, theirs = read_calibration(output).cameras, read_calibration(foreign).cameras
    for a, b in zip(ours, theirs, strict=True):
        assert np.abs(a.world_from_camera.difference(b.world_from_camera)).max() < 1e-6
        np.testing.assert_allclose(a.intrinsics.matrix, b.intrinsics.matrix, atol=1e-6)
    capture.substitute("capture.toml", "known.toml", name)
    assert main(["calibrate", str(capture.folder), "-o", str(output), "--overwrite"]) == 0
    assert cost_mm(capture) < 0.02


def test_a_foreign_file_of_something_else(altered, capsys) -> None:
    capture = altered("cam0", "cam2")
    capture.write("known.yml", "%YAML:1.0\n---\nanswer: 42\n")
    capture.substitute("capture.toml", "known.toml", "known.yml")
    assert "known.yml" in refusal(capture, capsys)


# --- what may be left out ---


def test_with_all_parts_nothing_is_noticed(altered, capsys) -> None:
    capture = altered("cam0", "cam2")
    judgement = written(capture)
    assert judgement["trustworthy"]
    assert not judgement["findings"]
    assert cost_mm(capture) < 0.02
    out, _ = capsys.readouterr()
    assert "marks kept out of the fit are missed by 0." in out
    assert "board and markers disagree by: cam0 0.1" in out
    assert "DO NOT TRUST" not in out


def with_crosses(capture: AlteredCapture, cameras: Sequence[str]) -> None:
    """Crosses where the dots were, none of them marked by hand."""
    capture.without_hand_marks()
    capture.substitute("capture.toml", r"\[capture\]\n", '[capture]\nmarker_kind = "cross"\n')
    places = np.array([line.split(",")[1:] for line in capture.lines("markers.csv")[1:]], float)
    for camera in read_calibration(capture.source / "truth_calibration.toml").cameras:
        if camera.name in cameras:
            drawn = picture(camera, places, np.random.default_rng(1))
            capture.change_picture(f"{camera.name}_markers.jpg", lambda _, drawn=drawn: drawn)


def test_crosses_are_found_and_named_too(altered) -> None:
    capture = altered("cam0", "cam2")
    with_crosses(capture, ("cam0", "cam2"))
    judgement = written(capture)
    assert judgement["trustworthy"]
    assert cost_mm(capture) < 0.02


def test_dots_where_the_file_says_crosses(altered, capsys) -> None:
    capture = altered("cam0", "cam2")
    with_crosses(capture, ("cam0",))
    said = refusal(capture, capsys)
    assert "camera cam2" in said
    assert "crosses" in said


def test_without_boards_the_marks_suffice(altered) -> None:
    capture = altered("cam0", "cam2")
    capture.without_boards()
    judgement = written(capture)
    assert "board_marker_disagreement_mm" not in judgement
    assert cost_mm(capture) < 0.1


def test_boards_alone_suffice(altered) -> None:
    capture = altered("cam0", "cam2")
    capture.without_markers()
    assert "held_out_px" not in written(capture)
    assert cost_mm(capture) < 0.02


def test_one_camera_without_marks(altered) -> None:
    capture = altered("cam0", "cam3")
    capture.keep_rows("marks.csv", lambda row: not row.startswith("cam3"))
    capture.substitute("capture.toml", r"marker_image = .*\n", "")
    judgement = written(capture)
    assert set(judgement["board_marker_disagreement_mm"]) == {"cam0"}
    assert cost_mm(capture) < 0.02


def test_neither_board_nor_marks_is_refused_before_lenses_take_minutes(altered) -> None:
    capture, done = altered("cam0", "cam3"), list[int]()
    capture.without_boards()
    capture.keep_rows("marks.csv", lambda row: not row.startswith("cam3"))
    with pytest.raises(CalibrationError, match="cam3: nothing tells where it stands"):
        api.calibrate(capture.folder, progress=lambda n, _: done.append(n))
    assert done == []


def test_markers_in_one_plane_alone_are_refused(altered, capsys) -> None:
    capture = altered("cam0")
    capture.without_boards()
    capture.keep_rows("markers.csv", lambda row: row.endswith("279.0"))
    high = {row.split(",")[0] for row in capture.lines("markers.csv")}
    capture.keep_rows("marks.csv", lambda row: row.split(",")[1] in high)
    assert "must not lie in one plane" in refusal(capture, capsys)


def test_five_markers_alone_are_refused(altered, capsys) -> None:
    capture = altered("cam0")
    capture.without_boards()
    capture.write("marks.csv", "\n".join(capture.lines("marks.csv")[:6]) + "\n")
    assert "at least 6 markers are needed, 5 are marked" in refusal(capture, capsys)


def test_a_video_for_the_lens(altered) -> None:
    capture = altered("cam0")
    path = capture.folder / "board.mp4"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (1280, 720))
    for number in range(0, 14, 2):
        video.write(capture.view("cam0", number))
    video.release()
    capture.substitute("capture.toml", r"calibration = .*", 'intrinsics = "board.mp4"')
    written(capture)
    camera = read_calibration(capture.folder / "calibration.toml").cameras[0]
    true = read_calibration(capture.source / "truth_calibration.toml").cameras[0]
    assert camera.intrinsics.focal_px == pytest.approx(true.intrinsics.focal_px, rel=5e-3)


# --- what goes wrong ---


def test_a_mirrored_board_picture(altered, capsys) -> None:
    capture = altered("cam1")
    capture.change_picture("cam1_board.jpg", mirrored)
    line = refusal(capture, capsys)
    assert "cam1: board and markers disagree by" in line
    assert "its board picture is mirrored" in line


def test_all_pictures_mirrored(altered, capsys) -> None:
    capture = altered("cam0")
    capture.without_hand_marks()
    for name in ("cam0_board.jpg", "cam0_markers.jpg"):
        capture.change_picture(name, mirrored)
    assert "is the picture mirrored?" in refusal(capture, capsys)


def test_two_board_pictures_swapped(altered, capsys) -> None:
    capture = altered("cam0", "cam2")
    capture.swap_board_pictures("cam0", "cam2")
    line = refusal(capture, capsys)
    assert "the board picture of cam2 fits instead: are the two swapped?" in line


def test_two_board_poses_swapped(altered, capsys) -> None:
    capture = altered("cam0", "cam2")
    capture.swap_board_poses()
    line = refusal(capture, capsys)
    assert "its board stands where the capture puts that of cam2" in line


@pytest.mark.parametrize(("name", "column"), [("marks.csv", 1), ("markers.csv", 0)])
def test_marker_names_permuted(altered, capsys, name: str, column: int) -> None:
    capture = altered("cam2")
    capture.rename_markers(name, column, MIXED)
    assert "marker names are mixed up: m0" in refusal(capture, capsys)


def test_names_do_not_matter_where_markers_are_found_by_place(altered) -> None:
    capture = altered("cam0", "cam2")
    capture.without_hand_marks()
    capture.rename_markers("markers.csv", 0, MIXED)
    assert written(capture)["trustworthy"]
    assert cost_mm(capture) < 0.02


def test_wrong_square_size(altered, capsys) -> None:
    capture = altered("cam0")
    capture.substitute("board.toml", r"25\.0", "24.0")
    assert "1.04 times the stated size: check square_mm" in refusal(capture, capsys)


def test_squares_a_little_off_are_noticed_by_the_second_target(altered) -> None:
    capture = altered("cam0", "cam1", "cam2", "cam3")
    capture.substitute("board.toml", r"25\.0", "24.9")
    judgement = written(capture)
    assert judgement["scale_of_markers_by_boards"] == pytest.approx(24.9 / 25, abs=3e-4)
    assert any("disagree about size" in text for text in judgement["findings"])
    assert cost_mm(capture) < 0.1


def test_camera_turned_half_a_degree_between_its_pictures(altered, capsys) -> None:
    capture = altered("cam1")
    capture.without_hand_marks()
    capture.change_picture("cam1_markers.jpg", turned(0.5, 1))
    assert "cam1: board and markers disagree by 4" in refusal(capture, capsys)


@pytest.mark.parametrize("zoom", [1.04, 1.25])
def test_pictures_of_another_zoom_than_the_lens_was_calibrated_with(altered, capsys, zoom) -> None:
    capture, said = altered("cam1"), "as large as the lens was calibrated with: zoom, focus"
    for name in ("cam1_board.jpg", "cam1_markers.jpg"):
        capture.change_picture(name, zoomed(zoom))
    rows = [row.split(",") for row in capture.lines("marks.csv")[1:]]
    places = np.array([row[2:] for row in rows], float)
    places = MIDDLE + zoom * (places - MIDDLE)
    kept = [f"{r[0]},{r[1]},{u:.3f},{v:.3f}" for r, (u, v) in zip(rows, places, strict=True)]
    capture.write("marks.csv", "\n".join(["camera,name,u_px,v_px", *kept]) + "\n")
    if zoom > 1.1:
        assert "fit pictures 1.25" in (line := refusal(capture, capsys))
        assert said in line
        return
    first, *others = written(capture)["findings"]
    assert re.match(rf"wrong: cam1: board and marks fit pictures {zoom:.2f}\d times {said}", first)
    assert not [text for text in others if "mark again" in text or "disagree" in text]


@pytest.mark.parametrize(("by_hand", "degrees", "axis"), [(True, 0.5, 2), (False, 0.1, 0)])
def test_camera_that_turned_a_little_is_reported_as_wrong(
    altered, capsys, by_hand: bool, degrees: float, axis: int
) -> None:
    capture = altered("cam0", "cam1")
    if by_hand:
        capture.change_picture("cam1_board.jpg", turned(degrees, axis))
    else:
        capture.without_hand_marks()
        capture.change_picture("cam1_markers.jpg", turned(degrees, axis))
    judgement = written(capture)
    assert not judgement["trustworthy"]
    assert judgement["findings"][0].startswith("wrong: camera cam1: board and markers disagree by")
    out, _ = capsys.readouterr()
    assert "wrong: camera cam1: board and markers disagree" in out
    assert "DO NOT TRUST this calibration" in out
    page = (capture.folder / "calibration.html").read_text()
    assert "the camera or the board moved between the two pictures" in page

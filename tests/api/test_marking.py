"""Marks in pictures: clicks that are refined, finds that are proposed, files that calibrate."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from measure import api
from measure.api.marking import found_tags, refined_mark
from measure.calibration.boards import Charuco
from measure.errors import CalibrationError, ConfigError
from measure.session import Calibration, read_calibration, write_calibration
from tests.calibration.rigs import cameras, markers
from tests.studio import waved

CAMERAS, POINTS = cameras()[:2], markers()
NAMES = [f"m{number:02d}" for number in range(len(POINTS))]


@pytest.fixture(scope="module")
def photographs():
    return {camera.name: waved.dots(camera, POINTS, 2.0) for camera in CAMERAS}


@pytest.fixture
def marking(tmp_path, photographs):
    """A capture of the photographs, as the page begins it, with the markers' places known."""
    for name, pixels in photographs.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), pixels)
    write_calibration(tmp_path / "calibration.toml", Calibration(CAMERAS))
    rows = [f"{n},{x},{y},{z}\n" for n, (x, y, z) in zip(NAMES, POINTS, strict=True)]
    places = tmp_path / "places.csv"
    places.write_text("name,x_mm,y_mm,z_mm\n" + "".join(rows))
    return api.begin_marks(tmp_path / "marks-1", tmp_path, tmp_path / "calibration.toml", places)


def inside(camera):
    """Names and places of the markers that are well inside the picture."""
    at = camera.project(POINTS)
    seen = camera.intrinsics.contains(at, 25.0)
    return {NAMES[k]: at[k] for k in np.flatnonzero(seen)}


def test_a_click_beside_a_marker_is_refined_to_its_middle(marking, rng):
    camera = CAMERAS[0]
    for name, at in inside(camera).items():
        mark = marking.set("cam0", name, tuple(at + rng.uniform(-4, 4, 2)), "dot")
        assert mark.refined
        # They are drawn round, but fitted as the ellipses that balls are off the middle.
        assert np.linalg.norm(np.array(mark.center_px) - at) < 0.15


@pytest.mark.parametrize("kind", ["dot", "cross", "corner"])
def test_a_click_far_from_every_marker_marks_nothing_unless_it_is_meant(marking, kind):
    with pytest.raises(ConfigError, match=f"cam0: no {kind} within .* nothing was marked for m00"):
        marking.set("cam0", "m00", (3.0, 4.0), kind)
    assert "m00" not in marking.marks["cam0"]
    meant = marking.set("cam0", "m00", (3.0, 4.0), "as clicked")
    assert not meant.refined
    assert meant.center_px == (3.0, 4.0)


def test_four_clicks_propose_the_others_and_the_capture_is_calibrated(marking, tmp_path, rng):
    for camera in CAMERAS:
        places = inside(camera)
        for name in sorted(places, key=lambda n: places[n][0])[::4]:
            marking.set(camera.name, name, tuple(places[name] + rng.uniform(-3, 3, 2)), "dot")
        clicked = set(marking.marks[camera.name])
        found = marking.propose(camera.name, api.TAG_FAMILIES[0])
        assert not clicked & {*found}
        assert {*found} | clicked == {*places}
    assert marking.save() == []
    again = api.Marking(marking.folder)
    assert again.marks["cam1"].keys() == marking.marks["cam1"].keys()
    result, _ = api.calibrate_to(marking.folder, tmp_path / "new.toml", api.Registry.discover())
    for found, there in zip(result.calibration.cameras, CAMERAS, strict=True):
        assert np.linalg.norm(found.center - there.center) < 0.3


def test_what_calibrate_will_refuse_is_said_when_marks_are_written(marking):
    """Everything is written nevertheless, and goes on to be completed."""
    places = inside(CAMERAS[0])
    for name in [*places][:5]:
        marking.set("cam0", name, tuple(places[name]), "dot")
    with pytest.raises(CalibrationError, match="cam0: without a board at least 6 markers"):
        marking.save()
    assert len(api.Marking(marking.folder).marks["cam0"]) == 5
    marking.set("cam0", [*places][5], tuple(places[[*places][5]]), "dot")
    with pytest.raises(CalibrationError, match="cam1: nothing tells where it stands"):
        marking.save()


def test_a_mark_whose_place_nobody_typed_is_left_out_and_named(marking):
    for camera in CAMERAS:
        for name, at in inside(camera).items():
            marking.set(camera.name, name, tuple(at), "dot")
    marking.set("cam0", "17", (200.0, 100.0), "as clicked")
    assert marking.save() == ["17"]
    with pytest.raises(ConfigError, match="17: expected its name, and x, y, z in mm"):
        marking.place("17", "12, 5")
    marking.place("17", "12.5 5 -3")
    assert marking.save() == []
    assert '"marks.csv"' in (marking.folder / "capture.toml").read_text()
    assert "17,12.5,5,-3" in (marking.folder / "markers.csv").read_text()


def test_tags_are_proposed_with_their_numbers_at_their_middles(rng):
    """The markers in a ChArUco board, seen at an angle."""
    board, camera, pose = waved.board(), waved.rig()[0], waved.waved(2.0)
    assert isinstance(board, Charuco)
    found = found_tags(waved.picture(camera, pose, rng), "4X4_100")
    middles = np.mean(board.pattern.getObjPoints(), axis=1)
    there = camera.project(pose.apply(np.asarray(middles, np.float64)))
    assert len(found) >= 15
    numbers = board.pattern.getIds().ravel().tolist()
    off = [np.array(mark.center_px) - there[numbers.index(int(n))] for n, mark in found.items()]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.1
    assert not found_tags(np.full((200, 200, 3), 128, np.uint8), "4X4_100")


def test_corners_are_refined_and_a_plain_ground_has_none(rng):
    camera, pose = waved.rig()[0], waved.waved(2.0)
    picture, at = waved.picture(camera, pose, rng), waved.corners(camera, pose)
    inner = [p for p in at if camera.intrinsics.contains(p[None], 20.0)[0]]
    assert len(inner) >= 10
    for place in inner:
        mark = refined_mark(
            picture, tuple(place + rng.uniform(-1.5, 1.5, 2)), "corner", camera.intrinsics
        )
        assert np.linalg.norm(np.array(mark.center_px) - place) < 0.25
    plain = np.full((200, 200, 3), 128, np.uint8)
    for kind in ("corner", "dot", "cross"):
        assert refined_mark(plain, (90.0, 80.0), kind, camera.intrinsics) is None


def test_a_capture_from_elsewhere_is_marked_by_the_lenses_of_a_calibration(renders):
    folder = renders / "E_calibration"
    with pytest.raises(CalibrationError, match="cam0 needs a calibration that knows its lens"):
        api.Marking(folder)
    marking = api.Marking(folder, folder / "truth_calibration.toml")
    before = dict(marking.marks["cam0"])
    assert len(before) >= 6
    for name, mark in before.items():
        again = marking.set("cam0", name, (mark.center_px[0] + 3.0, mark.center_px[1]), "dot")
        assert again.refined
        assert np.linalg.norm(np.array(again.center_px) - mark.center_px) < 1.0


def test_a_session_is_marked_by_the_outlines_of_its_balls(renders, tmp_path):
    session, body = renders / "still", renders / "still/body.toml"
    marking = api.begin_marks(tmp_path / "marks-1", session, session / "calibration.toml", body)
    true = {c.name: c for c in read_calibration(session / "calibration.toml").cameras}
    balls = api.read_body(body), api.Registry.discover()
    found = marking.propose("cam0", api.TAG_FAMILIES[0], "dot", balls)
    assert {*found} == {*marking.points}
    for mark in marking.marks["cam0"].values():
        assert mark.radius_px > 10
        assert true["cam0"].intrinsics.contains(np.array([mark.center_px]))[0]
    with pytest.raises(CalibrationError, match="at least 6 markers are needed, 3 are marked"):
        marking.save()


def test_pictures_of_another_size_are_refused_when_they_are_opened(tmp_path):
    write_calibration(tmp_path / "calibration.toml", Calibration(CAMERAS))
    for camera in CAMERAS:
        cv2.imwrite(str(tmp_path / f"{camera.name}.png"), np.zeros((100, 120, 3), np.uint8))
    with pytest.raises(CalibrationError, match="is 120x100 px, its lens is known for pictures of"):
        api.begin_marks(tmp_path / "marks-1", tmp_path, tmp_path / "calibration.toml")

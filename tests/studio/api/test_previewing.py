"""Pictures to look at: what is told of them, and of the cameras they come from."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from measure import api
from measure.errors import ConfigError, RunError
from measure.geometry import RigidTransform
from measure.measuring import Measurement
from measure.measuring.measurement import Status
from measure.model import Detection, Image, Pose
from measure.session import Calibration
from measure_lab import api as lab
from measure_studio import api as studio_api
from measure_studio.api import previewing
from measure_studio.api.previewing import PictureFacts, Preview, WatchedCamera
from tests.camera_server import ServedCamera, serving


def checked(bright=200):
    """A picture of sharp squares, BGR (480, 640, 3)."""
    v, u = np.mgrid[:480, :640]
    gray = np.where((u // 80 + v // 80) % 2, bright, 30).astype(np.uint8)
    return cv2.GaussianBlur(np.dstack([gray] * 3), (0, 0), 0.7)


@pytest.mark.parametrize("sd_px", [1.0, 2.0, 4.0])
def test_sharpness_is_the_slope_of_edges(sd_px):
    """Of an edge that is blurred by s px it is 1 / (s sqrt(2 pi)), whatever its contrast."""
    for bright in (90, 220):
        blurred = cv2.GaussianBlur(checked(bright), (0, 0), sd_px)
        expected = 1 / (np.hypot(sd_px, 0.7) * np.sqrt(2 * np.pi))
        assert PictureFacts.of(blurred).sharpness == pytest.approx(expected, rel=0.2)


def test_overexposed_share_and_empty_pictures():
    picture = checked()
    assert PictureFacts.of(picture).clipped_share == 0
    picture[:120, :, 2] = 255  # one channel is enough
    assert PictureFacts.of(picture).clipped_share == pytest.approx(0.25, abs=0.02)
    black = PictureFacts.of(np.zeros((48, 64, 3), np.uint8))
    assert (black.sharpness, black.level, black.clipped_share) == (0.0, 0.0, 0.0)


def test_a_shown_picture_marks_what_is_overexposed():
    picture = np.full((480, 640, 3), 60, np.uint8)
    picture[200:280, 280:360] = 255
    preview = Preview()
    assert preview.shown("cam0", 320) is None
    preview.add(Image("cam0", 0, 0.0, lambda: picture))
    jpeg, facts = preview.shown("cam0", 320)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (240, 320, 3)
    assert np.abs(shown[120, 160].astype(int) - [255, 0, 255]).max() < 20
    assert np.abs(shown[20, 20].astype(int) - 60).max() < 20
    assert preview.facts("cam0") == facts


def test_balls_are_drawn_into_the_picture_in_which_they_were_found(monkeypatch):
    """With their names; a newer picture comes once nothing was found for a moment."""
    found, newer = (np.full((480, 640, 3), level, np.uint8) for level in (60, 120))
    preview, clock = Preview(), SimpleNamespace(monotonic=lambda: 5.0)
    monkeypatch.setattr(previewing, "time", clock)
    image = Image("cam0", 0, 0.0, lambda: found)
    ball = Detection("Mötör", "cam0", 0.0, np.array([600.0, 200.0]), 30.0, np.eye(2), 1.0)
    preview.note_balls(image, [ball])
    preview.add(Image("cam0", 1, 0.1, lambda: newer))

    def shown():
        data = np.frombuffer(preview.shown("cam0", 640)[0], np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)

    assert shown()[40, 40] == pytest.approx(60, abs=3)
    assert shown()[200, 570] > 200  # the outline
    assert shown()[190:210, 480:566].max() > 200  # the name, left of it: there is no room right
    assert preview.balls("cam0") == ("Mötör",)
    clock.monotonic = lambda: 7.0
    assert np.ptp(shown()) < 6
    assert shown()[40, 40] == pytest.approx(120, abs=3)
    assert preview.balls("cam0") == ("Mötör",)


def test_what_is_found_while_a_picture_is_drawn_is_not_drawn_into_it():
    """It lies elsewhere in that one."""
    pixels = np.full((480, 640, 3), 60, np.uint8)
    ball = Detection("red", "cam0", 0.0, np.array([320.0, 200.0]), 30.0, np.eye(2), 1.0)
    before, preview = Image("cam0", 0, 0.0, lambda: pixels), Preview()

    def decode():
        preview.note_balls(before, [ball])
        return pixels

    preview.add(Image("cam0", 1, 0.1, decode))
    newer, found = (preview.shown("cam0", 640)[0] for _ in range(2))
    newer, found = (cv2.imdecode(np.frombuffer(j, np.uint8), 0) for j in (newer, found))
    assert np.ptp(newer) < 6
    assert found[200, 290] > 200


def test_corners_are_ringed_in_the_picture_in_which_they_were_found():
    """Though it was shown before without them; beside a corner nothing changes."""
    pixels = np.full((480, 640, 3), 60, np.uint8)
    preview, image = Preview(), Image("cam0", 0, 0.0, lambda: pixels)
    preview.add(image)
    before, _ = preview.shown("cam0", 320)
    preview.hold(image, np.array([[400.0, 200.0]]))
    ringed, _ = preview.shown("cam0", 320)
    plain, shown = (cv2.imdecode(np.frombuffer(j, np.uint8), 1)[..., 0] for j in (before, ringed))
    assert np.ptp(plain) < 6
    assert shown[96:105, 196:205].max() > 150
    assert np.abs(shown[:80].astype(int) - plain[:80]).max() < 6


def test_a_camera_that_is_not_there_holds_up_no_other():
    jpeg = cv2.imencode(".jpg", checked())[1].tobytes()
    preview = Preview()
    with serving({"cam0": ServedCamera([jpeg], 0.02)}) as found:
        words = [f"cam0={found['cam0']}", "cam1=http://127.0.0.1:1/x"]
        there, nowhere = (
            WatchedCamera(one, preview.add, studio_api.CaptureRequest())
            for one in studio_api.parse_cameras(words)
        )
        until_s = time.monotonic() + 20.0
        while there.now.problem or "refused" not in nowhere.now.problem:
            assert time.monotonic() < until_s
            time.sleep(0.05)
        assert preview.newest("cam0").pixels.shape == (480, 640, 3)
        assert preview.newest("cam1") is None
        for one in (there, nowhere):
            one.stop()


def test_rests_are_found_while_poses_come(rng, paper_body, webcam):
    """Two places, 5 mm apart: the distance and its uncertainty are those of the means."""
    rests = lab.RestsSoFar(paper_body, Calibration(()))
    covariance = np.diag([0.03**2] * 3 + [1e-3**2] * 3)
    assert not rests.find().rests
    for k in range(80):
        place = RigidTransform(np.eye(3), np.array([5.0 * (k >= 40), 0.0, 300.0]))
        off = rng.multivariate_normal(np.zeros(6), covariance)
        pose = Pose(k / 30, place.perturb(off), covariance, 0.0, 0.1, (), ())
        rests.add(Measurement(k, k / 30, {}, (), (), pose, Status.OK))
    lost = Measurement(80, 80 / 30, {}, (), (), None, Status.LOST, ("no ball",))
    rests.add(lost)
    found = rests.find()
    assert len(found) == 2
    move = found.displacement(0, 1)
    assert move.distance_mm == pytest.approx(5.0, abs=5 * move.distance_sd_mm)
    assert move.distance_sd_mm < 0.03


def test_nothing_outside_the_folder_is_touched(tmp_path):
    home, outside = tmp_path / "home", tmp_path / "outside.toml"
    home.mkdir()
    outside.touch()
    (home / "link.toml").symlink_to(outside)
    assert api.inside(home, "a/b.toml") == (home / "a" / "b.toml").resolve()
    for name in ("../outside.toml", str(outside), "link.toml", "a/../../outside.toml"):
        with pytest.raises(ConfigError, match="lies outside"):
            api.inside(home, name)


def test_events_are_marked_in_runs_alone(tmp_path):
    with pytest.raises(RunError, match="no run is there yet"):
        api.mark_event(tmp_path, "start")
    (tmp_path / "run.toml").touch()
    assert api.events(tmp_path) == []
    begun_s = time.time()
    api.mark_event(tmp_path, 'it said "go", twice')
    api.mark_event(tmp_path, "end")
    (first_s, first), (last_s, last) = api.events(tmp_path)
    assert (first, last) == ('it said "go", twice', "end")
    assert begun_s - 1e-5 < first_s <= last_s < time.time() + 1e-5


def test_files_are_known_by_what_they_hold(still, tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("calibration.toml", "body.toml", "session.toml"):
        (tmp_path / "sub" / name).write_bytes((still / name).read_bytes())
    (tmp_path / "broken.toml").write_text("cameras = [")
    api.draw_target("chessboard_9x6_25", tmp_path / "board.pdf")
    found = studio_api.contents_of(tmp_path)
    assert found.calibrations == (tmp_path / "sub" / "calibration.toml",)
    assert found.bodies == (tmp_path / "sub" / "body.toml",)
    assert found.boards == ()
    assert studio_api.next_free(tmp_path, "run") == "run-1"


def test_originals_come_before_the_copies_in_recordings(still, tmp_path):
    """However old they are; and learnt colours are no measured body."""
    (tmp_path / "session-2").mkdir()
    for name in ("calibration.toml", "body.toml", "session.toml"):
        (tmp_path / "session-2" / name).write_bytes((still / name).read_bytes())
    for name, source in (
        ("calibration.toml", "calibration.toml"),
        ("body-1.toml", "body.toml"),
        ("colours.toml", "body.toml"),
    ):
        (tmp_path / name).write_bytes((still / source).read_bytes())
        os.utime(tmp_path / name, (1e9, 1e9))
    found = studio_api.contents_of(tmp_path)
    names = [str(file.relative_to(tmp_path)) for file in found.calibrations + found.bodies]
    assert names == [
        "calibration.toml",
        "session-2/calibration.toml",
        "body-1.toml",
        "session-2/body.toml",
    ]
    said = [studio_api.described(file, tmp_path) for file in found.calibrations]
    assert said[0].startswith("calibration.toml · 09 Sep")
    assert said[1].endswith(" · a copy")

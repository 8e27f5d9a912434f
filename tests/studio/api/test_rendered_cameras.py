"""The cameras of `measure demo --studio`: true to their lenses, and what they show when."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import islice, takewhile
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from measure import api
from measure.calibration import read_board
from measure.cli import main
from measure.session import Calibration, write_body, write_calibration
from measure.simulation.catalogue import WORKSPACE_MM, webcam_scene
from measure_studio import api as studio_api
from measure_studio.api import rendered_cameras as demo
from measure_studio.api.held_boards import held_poses
from measure_studio.capture.mjpeg import HttpSource


def gray(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("name", studio_api.DEMO_BOARDS)
def test_a_board_is_seen_where_the_lens_shows_it(name, tmp_path):
    """The pose before the first camera: found to 0.1 px, whatever the board."""
    cameras, board = webcam_scene().cameras, read_board(api.shipped_targets()[name])
    pose = held_poses(cameras, board.points, WORKSPACE_MM)[0]
    demo._write_board(tmp_path / "act", name, [pose], lambda *_: None)
    one, other = ((tmp_path / f"act/cam0/{k:06d}.jpg").read_bytes() for k in range(2))
    assert one != other  # a camera whose picture repeats is taken for one that hangs
    seen = board.find(gray(one))
    assert len(seen.ids) >= 0.9 * len(board.points)
    off = seen.pixels - cameras[0].project(pose.apply(board.points[seen.ids]))
    assert np.sqrt(np.mean(off**2)) < 0.1


@pytest.mark.parametrize("name", studio_api.DEMO_BOARDS)
def test_neighbours_see_a_board_together_often_enough(name):
    """Whole and within 55 degrees, as a chessboard must be seen: or its waving never ends."""
    cameras, points = webcam_scene().cameras, read_board(api.shipped_targets()[name]).points
    poses = held_poses(cameras, points, WORKSPACE_MM)
    for one, other in zip(cameras, [*cameras[1:], cameras[0]], strict=True):
        shared = [pose for pose in poses if shows(one, pose, points) and shows(other, pose, points)]
        assert len(shared) >= 4


def shows(camera, pose, points):
    places = pose.apply(points)
    sight = places.mean(axis=0) - camera.center
    oblique = np.degrees(np.arccos(sight @ pose.rotation[:, 2] / np.linalg.norm(sight)))
    return oblique < 55 and camera.intrinsics.contains(camera.project(places), 12.0).all()


def test_the_folder_says_what_is_shown(tmp_path):
    scene = webcam_scene()
    assert demo._act_of(tmp_path) == "waved"
    given = Calibration(scene.cameras)
    write_calibration(tmp_path / "calibration.toml", given)
    assert demo._act_of(tmp_path) == "lying"
    write_body(tmp_path / "body-1.toml", scene.body)
    assert demo._act_of(tmp_path) == "body"
    (tmp_path / "body-1.toml").unlink()
    placed = replace(given, provenance={"world": {"by": "board"}})
    write_calibration(tmp_path / "calibration.toml", placed)
    assert demo._act_of(tmp_path) == "body"


def test_cameras_go_on_from_one_act_to_the_next(tmp_path, monkeypatch):
    """Readers stay connected, and the cameras' clock goes on."""
    boards = {}
    for act in ("waved", "lying", "body"):
        boards[act] = tmp_path / act
        names = [f"cam{k}" for k in range(4)]
        for name in names:
            (boards[act] / name).mkdir(parents=True)
            for k in range(2):
                level = (20 + 80 * len(boards), 90, 30 + k)
                data = cv2.imencode(".jpg", np.full((48, 64, 3), level, np.uint8))[1].tobytes()
                (boards[act] / name / f"{k:06d}.jpg").write_bytes(data)
        demo._write_texts(boards[act], names, 2)
    monkeypatch.setattr(demo, "_rendered", lambda *_: boards)
    with studio_api.demo_cameras(tmp_path) as (desk, cameras):
        shots = HttpSource(cameras["cam1"]).shots()
        before = [next(shots) for _ in range(4)]
        write_calibration(desk / "calibration.toml", Calibration(webcam_scene().cameras))
        waved = {shot.jpeg for shot in before}
        after = list(islice(takewhile(lambda shot: shot.jpeg in waved, shots), 300))
        after += [next(shots) for _ in range(4)]
        shots.close()
    assert waved.isdisjoint({shot.jpeg for shot in after[-4:]})
    stamps = np.array([shot.device_s for shot in (*before, *after)])
    assert np.diff(stamps).min() > 0
    assert desk == tmp_path / "rig-1"


@pytest.mark.parametrize(("look_s", "ticks"), [(0.0, 12), (0.2, 32)])
def test_a_board_is_held_as_long_as_this_computer_asks_for(look_s, ticks, tmp_path, monkeypatch):
    for k in range(4):
        (tmp_path / f"cam{k}").mkdir()
        cv2.imwrite(str(tmp_path / f"cam{k}/000000.jpg"), np.zeros((48, 64), np.uint8))
    slow = SimpleNamespace(look=lambda _: time.sleep(look_s))
    monkeypatch.setattr(demo.api, "read_board", lambda _: slow)
    assert ticks <= demo._held_ticks(tmp_path, studio_api.DEMO_BOARDS[0]) < ticks + 12


def test_another_board_is_refused(tmp_path, capsys):
    assert main(["demo", "--studio", "--board", "mine", "-o", str(tmp_path / "demo")]) == 2
    assert "charuco_8x5_27, chessboard_9x6_25" in capsys.readouterr().err

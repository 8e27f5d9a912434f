"""A board waved before web cameras: what is kept is a capture that can be opened."""

from __future__ import annotations

import threading

import cv2
import numpy as np

from measure.calibration import open_capture, read_board
from measure.host import Registry
from measure.session import is_session, session_lacks
from measure_studio import api as studio_api
from tests.camera_server import ServedCamera, serving
from tests.studio import waved

KALIBR = """
target_type: 'checkerboard'
targetCols: 9
targetRows: 6
rowSpacingMeters: 0.025
colSpacingMeters: 0.025
"""
POSES_S = (0.0, 3.0, 6.4, 7.5)


def jpegs(camera, rng):
    target = waved.plain_board()
    poses = [waved.waved(t, target) for t in np.repeat(POSES_S, 4)]
    pictures = [waved.picture(camera, pose, rng, target) for pose in poses]
    return [cv2.imencode(".jpg", one)[1].tobytes() for one in pictures]


def test_a_board_in_kalibrs_words_is_waved(tmp_path, rng):
    """The capture names the board as it was given, and holds pictures in which it is found."""
    board, out = tmp_path / "target.yaml", tmp_path / "capture"
    board.write_text(KALIBR, "utf-8")
    served = {c.name: ServedCamera(jpegs(c, rng), 0.15, stamps=True) for c in waved.rig()}
    stop = threading.Event()

    def hear(state):
        if all(seen.views for seen in state.cameras.values()):
            stop.set()

    with serving(served) as addresses:
        cameras = studio_api.parse_cameras([f"{name}={at}" for name, at in addresses.items()])
        options = studio_api.CaptureOptions(seconds=60.0, stop=stop)
        state = studio_api.capture_board(cameras, board, out, options, on_state=hear)
    assert all(seen.views for seen in state.cameras.values())
    opened = open_capture(out)
    assert opened.board == read_board(board)
    for camera in opened.cameras:
        kept = [pixels for _, pixels in opened.views(camera)]
        assert len(kept) == state.cameras[camera.name].views
        assert all(opened.board.find(pixels[:, :, 0]) is not None for pixels in kept)


def test_a_waved_body_is_recorded_as_it_is_looked_at(still, tmp_path):
    """The session names the body and no calibration; its balls were found in every camera."""
    out, names = tmp_path / "waved-1", ("cam0", "cam1")
    pictures = {n: [f.read_bytes() for f in sorted((still / n).glob("*.jpg"))] for n in names}
    served = {n: ServedCamera(some, 0.2, stamps=True) for n, some in pictures.items()}
    stop, seen = threading.Event(), dict.fromkeys(names, 0)

    def hear(state):
        if all(one.views for one in state.cameras.values()) and min(seen.values()) > 1:
            stop.set()

    def see(images, balls):
        for image in images:
            best = studio_api.best_balls(balls[image.camera])
            seen[image.camera] = max(seen[image.camera], len(best))

    with serving(served) as addresses:
        cameras = studio_api.parse_cameras([f"{name}={at}" for name, at in addresses.items()])
        options = studio_api.CaptureOptions(seconds=90.0, stop=stop)
        state = studio_api.capture_body(
            cameras, out, Registry.discover(), options,
            body=still / "body.toml", on_state=hear, on_balls=see,
        )  # fmt: skip
    assert seen == dict.fromkeys(names, 3)
    assert not state.enough
    assert "cam0 and cam1: show the body to both at once" in state.advice
    assert is_session(out)
    assert session_lacks(out) == ["calibration"]
    assert all(any((out / name).glob("*.jpg")) for name in names)

"""Captures that contradict themselves, and what a capture states of its boards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.api import calibrate
from measure.calibration.extrinsics import held_within
from measure.errors import CalibrationError, ConfigError, PluginError
from measure.geometry import RigidTransform
from measure.model import BoardObservation
from measure.session import read_calibration
from tests.calibration.altered import AlteredCapture
from tests.calibration.rigs import BOARD


@pytest.fixture
def altered(renders: Path, tmp_path: Path) -> Callable[..., AlteredCapture]:
    source = renders / "E_calibration"
    return lambda *cameras: AlteredCapture(source, tmp_path / "capture", cameras)


@pytest.mark.parametrize("picture", ["cam0_board.jpg", "cam0_markers.jpg"])
def test_a_picture_of_another_size_than_the_lens_is_refused(altered, picture: str) -> None:
    capture = altered("cam0")
    capture.without_hand_marks()
    capture.change_picture(picture, lambda bgr: bgr[40:])
    said = rf"camera cam0: .*{picture} is 1280x680 px, .* pictures of 1280x720 px"
    with pytest.raises(CalibrationError, match=said):
        calibrate(capture.folder)


def test_one_camera_is_located_by_a_board_alone(altered) -> None:
    capture = altered("cam0")
    capture.without_markers()
    result = calibrate(capture.folder)
    assert np.all(np.abs(result.verdict.workspace.center - [0, 0, 280]) < 60)
    assert np.all(result.verdict.position_sd_mm < 0.1)
    true = read_calibration(capture.source / "truth_calibration.toml").camera("cam0")
    assert np.linalg.norm(result.calibration.cameras[0].center - true.center) < 0.4


def offer(install, name: str, answer: str) -> None:
    """A package with a camera fit."""
    source = f"""
        import numpy as np
        from measure.model import RigFit
        def fit(start, observations, mark_sd_px):
            return RigFit({answer}, 1.0)
        """
    install(name, source, entry_point="fit", group="measure.camera_fits", offers=":fit")


@pytest.mark.parametrize("answer", ["start, 1 / 0", "start, np.eye(5)", "start[:0], np.eye(0)"])
def test_a_strangers_camera_fit_is_not_believed_blindly(altered, install, answer) -> None:
    offer(install, "acme", answer)
    with pytest.raises(PluginError, match=r"^the camera fit 'fit' (fails|answers nonsense): "):
        calibrate(altered("cam0").folder, "fit")


def test_a_camera_fit_is_that_of_one_package(altered, install) -> None:
    folder = altered("cam0").folder
    with pytest.raises(ConfigError, match=r"no calibration method is called 'joind'; .*'joint'"):
        calibrate(folder, "joind")
    offer(install, "acme", "start, np.eye(6)")
    assert calibrate(folder, "fit").calibration.provenance["method"] == "fit"
    offer(install, "other", "start, np.eye(6)")
    with pytest.raises(ConfigError, match=r"`--method fit` is that of acme 1.0 and of other 1.0"):
        calibrate(folder, "fit")


SIGHTS = {"cam0": BoardObservation(BOARD.points, np.zeros((54, 2)), RigidTransform.identity())}


def test_unstated_board_tolerance_moves_the_rim_as_much() -> None:
    shift_mm, turn_deg = held_within(SIGHTS, 0.3)
    assert shift_mm == 0.3
    assert 0.1 < turn_deg < 0.5  # the rim of 200 x 125 mm
    again = held_within(SIGHTS, None, turn_deg)
    assert again == pytest.approx((0.3, turn_deg))
    assert held_within(SIGHTS, 0.3, 1.0) == (0.3, 1.0)
    assert held_within(SIGHTS, None) == (0.0, 0.0)
    assert held_within({}, 0.3) == (0.0, 0.0)


@pytest.mark.parametrize("stated", ["board_tolerance_mm = 0.2", "board_tolerance_deg = 0.15"])
def test_a_capture_that_states_one_tolerance_has_both(altered, stated: str) -> None:
    capture = altered("cam0", "cam2")
    capture.substitute("capture.toml", r"\[capture\]\n", f"[capture]\n{stated}\n")
    tolerances = calibrate(capture.folder).rig.tolerances
    assert tolerances.board_mm == pytest.approx(0.2, rel=0.5)
    assert tolerances.board_deg == pytest.approx(0.15, rel=0.5)


def test_common_views_of_a_camera_in_mirror_mode(shared: Path, tmp_path: Path) -> None:
    """The stereo pair's pictures as videos, the left ones mirrored."""
    (tmp_path / "board.toml").write_text(
        'kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = 25.0\n'
    )
    text = '[capture]\nname = "stereo"\nboard = "board.toml"\ncommon_views = true\n'
    for name in ("left", "right"):
        files = sorted((shared / "data/opencv_stereo").glob(f"{name}*.jpg"))
        pictures = [cv2.imread(str(file)) for file in files]
        code, size = cv2.VideoWriter.fourcc(*"MJPG"), pictures[0].shape[1::-1]
        video = cv2.VideoWriter(str(tmp_path / f"{name}1.avi"), code, 10, size)
        for picture in pictures:
            video.write(cv2.flip(picture, 1) if name == "left" else picture)
        video.release()
        text += f'[[cameras]]\nname = "{name}"\nintrinsics = "{name}1.avi"\n'
    (tmp_path / "capture.toml").write_text(text)
    with pytest.raises(CalibrationError, match="camera right: its pictures are mirrored, or those"):
        calibrate(tmp_path)

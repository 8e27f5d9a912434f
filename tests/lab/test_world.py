"""A calibration in a world of the user's: an exact change of coordinates, covariances with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.calibration import Charuco
from measure.cli import main
from measure.errors import CalibrationError, ConfigError, RunError
from measure.estimation.pose_fit import PoseObservations, fit_pose
from measure.geometry import RigidTransform
from measure.model import Detection
from measure.results import read_run
from measure.results.pose_table import poses_of as poses_in
from measure.session import Calibration, read_calibration, write_calibration
from measure_lab import api
from tests.metrology.recordings import Errors, poses_of, with_rests, write_run
from tests.results.conftest import BODY, CAMERAS

PLACES = np.array([[10.0, 0, 20], [60, 5, 20], [15, 50, 25]])


@pytest.fixture
def uncertain(rng):
    """Cameras with covariances that differ by axis, and are correlated with the lens."""
    root = rng.normal(0, [[0.1]] * 3 + [[1e-4]] * 3, (6, 6))
    lens = np.diag([4.0, 4, 1, 1, *[1e-4] * 4, *[0.0] * 4])
    cross = 0.05 * root @ rng.normal(size=(6, 12)) * np.sqrt(np.diag(lens))
    return tuple(
        replace(
            c,
            intrinsics=replace(c.intrinsics, covariance=lens),
            pose_covariance=root @ root.T + np.diag([0.01] * 3 + [1e-8] * 3),
            pose_intrinsics_covariance=cross,
        )
        for c in CAMERAS
    )


@pytest.fixture
def made(tmp_path: Path, rng, uncertain) -> tuple[Path, Path]:
    truth = with_rests(PLACES)
    turned = RigidTransform.from_rotvec([0.3, -0.2, 0.7]) @ truth
    run = write_run(tmp_path / "run", poses_of(turned, Errors(nearby=0.8), rng), BODY, uncertain)
    joint = rng.normal(size=(42, 42))
    file = tmp_path / "calibration.toml"
    write_calibration(file, Calibration(uncertain, {"joint_covariance": joint @ joint.T}))
    return run, file


def seen_by(cameras, pose):
    return [
        Detection(ball, camera.name, 0.0, pixel, 60.0, np.eye(2))
        for camera in cameras
        for ball, pixel in zip(BODY.names, camera.project(pose.apply(BODY.centers)), strict=True)
    ]


def test_poses_of_the_same_pictures_are_the_old_ones_seen_from_the_new_world(made, tmp_path):
    run, file = made
    out = tmp_path / "new.toml"
    assert main(["world", str(file), "--run", str(run), "--at", "1.2", "-o", str(out)]) == 0
    cameras = read_calibration(out).cameras
    old = poses_in(read_run(run))
    at = old.world_from_body[36]
    for k in (0, 36, 60):
        pose = old.world_from_body[k]
        seen = PoseObservations.of(seen_by(CAMERAS, pose), BODY, {c.name: c for c in cameras}, 0.0)
        found = fit_pose(at.inverse() @ pose, seen).world_from_body
        assert np.allclose(found.difference(at.inverse() @ pose), 0, atol=1e-6)
        if k == 36:
            assert np.allclose(found.matrix, np.eye(4), atol=1e-6)


def test_covariances_turn_with_the_world(made, tmp_path, uncertain, rng):
    """Draws of the old cameras, moved one by one, scatter as the new file states."""
    found, place = api.world(made[1], made[0], rest=1)
    back = place.transform.inverse()
    for old, new in zip(uncertain, found.cameras, strict=True):
        draws = rng.multivariate_normal(np.zeros(18), old.covariance, 4000, check_valid="ignore")
        moved = back @ old.world_from_camera.perturb(draws[:, :6])
        off = np.column_stack([moved.difference(new.world_from_camera), draws[:, 6:]])
        scale = np.sqrt(np.diag(new.covariance)) + 1e-12
        differ = (np.cov(off.T) - new.covariance) / np.outer(scale, scale)
        assert np.abs(differ).max() < 0.12
    before = np.array(read_calibration(made[1]).provenance["joint_covariance"])
    after = np.array(found.provenance["joint_covariance"])
    assert np.linalg.eigvalsh(after) == pytest.approx(
        np.linalg.eigvalsh(before), rel=1e-6, abs=1e-6
    )
    turn = back.rotation
    assert np.allclose(after[14:17, 14:17], turn @ before[14:17, 14:17] @ turn.T)
    assert np.allclose(after[6:14, 6:14], before[6:14, 6:14])


def test_three_touched_points_make_a_frame(made):
    found, place = api.world(made[1], made[0], points=(0, 1, 2))
    rests = api.rests(made[0])
    touched = np.stack([rest.world_from_body.translation for rest in rests.rests])
    seen = place.transform.inverse().apply(touched)
    assert np.allclose(seen[0], 0, atol=1e-9)
    assert np.allclose(seen[1, 1:], 0, atol=1e-9)
    assert seen[1, 0] > 0 < seen[2, 1]
    assert seen[2, 2] == pytest.approx(0, abs=1e-9)
    assert 0.005 < np.sqrt(place.covariance[0, 0]) < 0.5
    assert len(found.cameras) == len(CAMERAS)
    with pytest.raises(RunError, match="on one line"):
        api.world(made[1], made[0], points=(0, 1, 0))


def test_mistakes_are_told(made, tmp_path, capsys):
    run, file = made
    with pytest.raises(ConfigError, match="give one"):
        api.world(file, run, 1.0, 1)
    with pytest.raises(RunError, match="there are 3 rests, 0 to 2"):
        api.world(file, run, rest=3)
    with pytest.raises(RunError, match=r"no unflagged pose at 99.000 s: it spans 0.000 to"):
        api.world(file, run, 99.0)
    other = tmp_path / "other.toml"
    write_calibration(
        other,
        Calibration(
            tuple(
                replace(c, world_from_camera=c.world_from_camera.perturb([1.0, 0, 0, 0, 0, 0]))
                for c in CAMERAS
            )
        ),
    )
    with pytest.raises(CalibrationError, match="another calibration"):
        api.world(other, run)
    own = tmp_path / "notes.toml"
    own.write_text("mine = 1\n")
    assert main(["world", str(file), "--run", str(run), "-o", str(own)]) == 2
    assert own.read_text() == "mine = 1\n"
    assert "is there already: --overwrite" in capsys.readouterr().err


CHARUCO = Charuco((8, 5), 27.0, 20.0, "DICT_4X4_50")


def photographed(camera, world_from_board):
    """The board as a camera sees it, on grey; its plane's homography, four pixels to a mm."""
    width, height = (27 * n for n in CHARUCO.squares)
    printed = CHARUCO.pattern.generateImage((4 * width, 4 * height))
    place = camera.camera_from_world @ world_from_board
    flat = np.column_stack([place.rotation[:, :2], place.translation])
    mm_from_print = np.array([[0.25, 0, 0.125], [0, 0.25, 0.125], [0, 0, 1]])
    return cv2.warpPerspective(
        printed, camera.intrinsics.matrix @ flat @ mm_from_print, camera.intrinsics.size_wh,
        flags=cv2.INTER_AREA, borderValue=150,
    )  # fmt: skip


def write_board(folder, cameras, places):
    folder.mkdir()
    for camera, place in zip(cameras, places, strict=True):
        cv2.imwrite(str(folder / f"{camera.name}.png"), photographed(camera, place))
    return folder


# Lying flat below the cameras: the board's z points into the table.
ON_TABLE = RigidTransform.from_rotvec([np.pi - 0.05, 0.1, 0.2], [-60.0, 90.0, 10.0])


def test_the_world_of_a_board_has_its_corner_its_x_and_z_upwards(tmp_path, made, uncertain):
    _, file = made
    given, place = api.world_by_board(
        file, "charuco_8x5_27", write_board(tmp_path / "b", uncertain, [ON_TABLE] * 3)
    )
    off = place.transform.difference(ON_TABLE @ RigidTransform(np.diag([1.0, -1, -1]), np.zeros(3)))
    assert np.linalg.norm(off[:3]) < 0.2
    assert np.degrees(np.linalg.norm(off[3:])) < 0.1
    assert place.transform.rotation[2, 2] > 0.9
    new, old = given.cameras[0], read_calibration(file).cameras[0]
    point = np.array([5.0, 6.0, 7.0])
    same = new.project(place.transform.inverse().apply(point)[None])
    assert same == pytest.approx(old.project(point[None]), abs=1e-6)


def shifted(camera, off):
    """A camera whose pose and camera matrix are less by (18,)."""
    lens = camera.intrinsics
    matrix = lens.matrix - [[off[6], 0, off[8]], [0, off[7], off[9]], [0, 0, 0]]
    pose = camera.world_from_camera.perturb(-off[:6])
    return replace(camera, world_from_camera=pose, intrinsics=replace(lens, matrix=matrix))


def test_a_boards_frame_states_what_uncertain_cameras_do_to_it(tmp_path, made, uncertain, rng):
    """Pictures by cameras off by draws from their covariance: errors are as large as stated."""
    _, file = made
    truth = ON_TABLE @ RigidTransform(np.diag([1.0, -1, -1]), np.zeros(3))
    squares = []
    for draw in range(8):
        off = [rng.multivariate_normal(np.zeros(18), c.covariance) for c in uncertain]
        true = [shifted(c, d) for c, d in zip(uncertain, off, strict=True)]
        folder = write_board(tmp_path / f"b{draw}", true, [ON_TABLE] * 3)
        _, place = api.world_by_board(file, "charuco_8x5_27", folder)
        error = place.transform.difference(truth)
        squares.append(error @ np.linalg.solve(place.covariance, error) / 6)
    assert 0.3 < np.mean(squares) < 2.0


@pytest.mark.parametrize(
    ("board", "change", "said"),
    [
        ("charuco_8x5_27", "moved", "did the board or a camera move"),
        ("charuco_8x5_27", "blank", "no board found in any of 3 pictures"),
        ("charuco_8x5_27", "renamed", "no picture named like a camera"),
        ("plain.toml", "", "looks the same after half a turn"),
    ],
)
def test_boards_that_tell_no_frame(tmp_path, made, capsys, board, change, said):
    _, file = made
    places = [ON_TABLE] * 3
    if change == "moved":
        places[1] = RigidTransform(np.eye(3), np.array([25.0, 0, 0])) @ ON_TABLE
    folder = write_board(tmp_path / "b", CAMERAS, places)
    for picture in folder.iterdir():
        if change == "blank":
            cv2.imwrite(str(picture), np.full((720, 1280), 150, np.uint8))
        elif change == "renamed":
            picture.rename(folder / f"x{picture.name}")
    (tmp_path / "plain.toml").write_text(
        'kind = "chessboard"\nname = "p"\ninner_corners = [8, 6]\nsquare_mm = 25.0\n'
    )
    named = str(tmp_path / board) if board.endswith("toml") else board
    out = tmp_path / "new.toml"
    command = ["world", str(file), "--board", named, "--pictures", str(folder), "-o", str(out)]
    assert main(command) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()

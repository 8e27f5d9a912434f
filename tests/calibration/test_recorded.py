"""Calibration of recorded and rendered captures whose answers are known."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.errors import body_cost
from measure.api import calibrate
from measure.arrays import Floats
from measure.calibration import calibrate_lens, find_views, read_board
from measure.calibration.capture import Capture, CaptureCamera, CaptureTable
from measure.calibration.targets import MarkerField
from measure.errors import CalibrationError
from measure.geometry import Rays, RigidTransform, align_points, nearest_point
from measure.model import Camera, Intrinsics, paper_body
from measure.session import Calibration, read_calibration, write_calibration


@dataclass(frozen=True, eq=False)
class SeedRig:
    folder: Path
    values: dict[str, Any]
    lens: Intrinsics

    def balls(self, cameras: tuple[Camera, ...]) -> Floats:
        found = []
        for ball in self.values["placements"]["placement_a"]:
            rays = [c.rays(np.array([ball["uv_px"][c.name]])) for c in cameras]
            origins = np.concatenate([r.origins for r in rays])
            found.append(nearest_point(Rays(origins, np.concatenate([r.directions for r in rays]))))
        return np.stack(found)


@pytest.fixture(scope="module")
def seed_rig(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> SeedRig:
    values = json.loads((shared / "data/seed_rig/seed_rig.json").read_text())
    folder, i = tmp_path_factory.mktemp("seed"), values["intrinsics"]
    matrix = np.array(
        [[i["fx"], 0, i["cx_1based"] - 1], [0, i["fy"], i["cy_1based"] - 1], [0, 0, 1]]
    )
    lens = Intrinsics((1280, 720), matrix)
    known = Calibration((Camera("rig", lens, RigidTransform.identity()),))
    write_calibration(folder / "known.toml", known)
    markers, marks = ["name,x_mm,y_mm,z_mm"], ["camera,name,u_px,v_px"]
    for marker in values["markers"]:
        markers.append(",".join(map(str, [marker["name"], *marker["xyz_mm"]])))
        for camera, pixel in marker["uv_px"].items():
            marks.append(",".join(map(str, [camera, marker["name"], *pixel])))
    (folder / "markers.csv").write_text("\n".join(markers))
    (folder / "marks.csv").write_text("\n".join(marks))
    text = '[capture]\nname = "seed"\nmarkers = "markers.csv"\nmarks = "marks.csv"\n'
    for name in values["cameras"]:
        text += f'[[cameras]]\nname = "{name}"\ncalibration = "known.toml"\n'
    (folder / "capture.toml").write_text(text)
    return SeedRig(folder, values, lens)


def test_paper_marks_are_flagged_and_give_least_squares_balls(seed_rig: SeedRig) -> None:
    result = calibrate(seed_rig.folder)
    rms = [camera.reprojection_rms_px for camera in result.calibration.cameras]
    np.testing.assert_allclose(rms, [3.6, 1.8, 3.5, 1.9], atol=0.1)
    flagged = {f.camera for f in result.verdict.findings if "too large for sub-mm" in f.text}
    assert flagged == {"cam0", "cam1", "cam2", "cam3"}
    assert not result.verdict.trustworthy
    least_squares = []
    points = np.array([m["xyz_mm"] for m in seed_rig.values["markers"]], dtype=float)
    for name in seed_rig.values["cameras"]:
        pixels = np.array([m["uv_px"][name] for m in seed_rig.values["markers"]], dtype=float)
        _, turn, shift = cv2.solvePnP(points, pixels, seed_rig.lens.matrix, None)
        pose = RigidTransform.from_rotvec(turn.ravel(), shift.ravel()).inverse()
        least_squares.append(Camera(name, seed_rig.lens, pose))
    balls = seed_rig.balls(result.calibration.cameras)
    apart = np.linalg.norm(balls - seed_rig.balls(tuple(least_squares)), axis=1)
    assert apart.max() < 0.05
    stated = np.array(
        [b["xyz_mm"] for b in seed_rig.values["placements"]["placement_a"]], dtype=float
    )
    assert np.all(np.abs(np.linalg.norm(balls - stated, axis=1) - [2.95, 2.86, 2.40]) < 0.2)
    shape = align_points(stated, balls).apply(balls) - stated
    assert np.sqrt(np.mean(np.sum(shape**2, axis=1))) < 0.4


@pytest.mark.slow
def test_a_stereo_pair_of_long_ago(shared: Path, tmp_path: Path) -> None:
    for file in (shared / "data/opencv_stereo").glob("*.jpg"):
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "board.toml").write_text(
        'kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = 25.0\n'
    )
    text = '[capture]\nname = "stereo"\nboard = "board.toml"\ncommon_views = true\n'
    for name in ("left", "right"):
        text += f'[[cameras]]\nname = "{name}"\nintrinsics = "{name}*.jpg"\n'
    (tmp_path / "capture.toml").write_text(text)
    result = calibrate(tmp_path)
    left, right = result.calibration.cameras
    assert np.linalg.norm(right.center) == pytest.approx(83.2, rel=1e-3)
    lenses = result.rig.lenses
    assert lenses["left"].fit.rms_px < 0.195
    assert lenses["right"].fit.rms_px < 0.207
    assert lenses["left"].intrinsics.focal_px == pytest.approx(532.8, rel=2e-3)
    assert lenses["right"].intrinsics.focal_px == pytest.approx(537.5, rel=2e-3)
    assert left.reprojection_rms_px is not None


def test_a_picture_without_a_board_is_refused_politely(shared: Path) -> None:
    folder = shared / "data/caliscope_4cam/chessboard_intrinsic"
    board = read_board(Path(__file__).parents[2] / "calibration_targets/chessboard_9x6_25.toml")
    without = []
    for file in sorted(folder.glob("*.jpg")):
        gray = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)
        if board.find(gray) is None:
            without = [(file.name, np.dstack([gray] * 3))]
            break
    assert without
    with pytest.raises(CalibrationError, match="cam: no board found in any of"):
        find_views(board, without, "cam")


@pytest.mark.slow
def test_the_rendered_capture_costs_the_body_next_to_nothing(renders: Path) -> None:
    folder = renders / "E_calibration"
    result = calibrate(folder)
    true = read_calibration(folder / "truth_calibration.toml").cameras
    rng = np.random.default_rng(0)
    poses = [
        RigidTransform.from_rotvec(rng.uniform(-0.6, 0.6, 3), rng.uniform(-40, 40, 3))
        for _ in range(30)
    ]
    lift = np.array([0.0, 0.0, 250.0])
    poses = [RigidTransform(p.rotation, p.translation + lift) for p in poses]
    shifts = body_cost(result.calibration.cameras, true, paper_body(), poses)
    assert np.sqrt(np.mean(np.sum(shifts**2, axis=1))) < 0.02
    for camera, exact in zip(result.calibration.cameras, true, strict=True):
        error = exact.world_from_camera.difference(camera.world_from_camera)
        assert camera.pose_covariance is not None
        assert error @ np.linalg.solve(camera.pose_covariance, error) / 6 < 4
        corner_px = np.hypot(*camera.intrinsics.size_wh) / 2
        assert np.all(np.abs(camera.intrinsics.lateral_color) * corner_px < 0.08), "it has none"
    assert result.verdict.trustworthy


@pytest.mark.slow
@pytest.mark.parametrize(("number", "focal_px"), [(2, 642)])
def test_four_real_webcams_from_inverted_charuco_videos(
    shared: Path, tmp_path: Path, number: int, focal_px: float
) -> None:
    """Within 6 % of what OpenCV makes of another program's corners: so much the views tell."""
    videos = shared / "data/caliscope_4cam/prerecorded_intrinsic"
    (tmp_path / "board.toml").write_text(
        'kind = "charuco"\ninner_corners = [3, 4]\nsquare_mm = 54.0\nmarker_mm = 40.5\n'
        'dictionary = "DICT_4X4_1000"\ninverted = true\n'
    )
    camera = CaptureCamera(name=f"cam{number}", intrinsics=f"cam_{number}.mp4")
    board, table = read_board(tmp_path / "board.toml"), CaptureTable(name="lenses")
    capture = Capture(videos / "capture.toml", table, board, MarkerField(), (camera,))
    found = calibrate_lens(
        board, find_views(board, capture.views(camera), camera.name), camera.name
    )
    assert found.fit.rms_px < 0.3
    assert found.intrinsics.focal_px == pytest.approx(focal_px, rel=0.06)
    assert (found.views.mirrored > 0) == (number == 1)

"""A synthetic rig with exact truth: four cameras, boards of known pose, sixteen markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.errors import body_cost
from measure.arrays import Floats
from measure.calibration import Board, Chessboard, Corners
from measure.calibration.board_views import board_pose
from measure.calibration.starts import SeenBoard
from measure.estimation import body_pose_sd
from measure.geometry import RigidTransform
from measure.model import Camera, CameraFit, Intrinsics, paper_body
from measure.model.rig_fit import MarkerObservation, RigObservations, Tolerances

BOARD = Chessboard((9, 6), 25.0)
SIZE = (1280, 720)
LENS_SD = np.array([0.4, 0.4, 0.4, 0.4])


def looking_at(center: Floats, target: Floats) -> RigidTransform:
    """world_from_camera of a camera at `center` that looks at `target`, z of the world up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(np.column_stack([right, np.cross(forward, right), forward]), center)


def lens(number: int) -> Intrinsics:
    matrix = np.array([[1400.0 + 12 * number, 0, 630 + 8 * number], [0, 1404.0, 365], [0, 0, 1]])
    return Intrinsics(SIZE, matrix, np.array([0.06, -0.12, 0.0006, -0.0008, 0.0]))


def cameras(azimuths_deg: Sequence[float] = (50, 130, 228, 318)) -> tuple[Camera, ...]:
    out = []
    for number, azimuth in enumerate(np.deg2rad(azimuths_deg)):
        center = np.array([410 * np.cos(azimuth), 410 * np.sin(azimuth), 380.0 + 5 * number])
        pose = looking_at(center, np.array([0.0, 0.0, 250.0]))
        out.append(Camera(f"cam{number}", lens(number), pose))
    return tuple(out)


def markers() -> Floats:
    places = [(127, 127), (-127, 127), (-127, -127), (127, -127), (127, 0), (0, 127), (-127, 0)]
    return np.array([(x, y, z) for x, y in [*places, (0, -127)] for z in (216.0, 279.0)])


def board_poses(rng: np.random.Generator, count: int) -> list[RigidTransform]:
    """camera_from_board of views that tilt in all directions and reach the image's corners."""
    poses = []
    for number in range(count):
        axis = rng.normal(size=3) * [1, 1, 0.3]
        angle = np.deg2rad(rng.uniform(15, 35))
        turn = RigidTransform.from_rotvec(angle * axis / np.linalg.norm(axis)).rotation
        column, row = number % 3 - 1, number // 3 % 3 - 1
        centre = np.array([column * 75.0, row * 32.0, rng.uniform(430, 560)])
        poses.append(RigidTransform(turn, centre - turn @ BOARD.points.mean(axis=0)))
    return poses


def board_views(
    intrinsics: Intrinsics,
    rng: np.random.Generator,
    count: int = 12,
    sd_px: float = 0.05,
    board: Board = BOARD,
) -> tuple[Corners, ...]:
    views = []
    for number, pose in enumerate(board_poses(rng, count)):
        pixels = intrinsics.project(pose.apply(board.points))
        pixels = pixels + rng.normal(0, sd_px, pixels.shape)
        views.append(Corners(np.arange(len(pixels)), pixels, 0.4, f"view{number}.jpg"))
    return tuple(views)


@dataclass(frozen=True, eq=False)
class Rig:
    true: tuple[Camera, ...]
    start: tuple[Camera, ...]
    observations: RigObservations
    seen: dict[str, SeenBoard]


def rig(
    rng: np.random.Generator,
    corner_sd_px: float = 0.05,
    mark_sd_px: float = 0.3,
    marker_mm: float = 0.0,
    lens_sd: Floats | None = None,
) -> Rig:
    """A rig seen with noise; `start` has the lenses as a separate calibration would give them."""
    true, points = cameras(), markers()
    placed = points + rng.normal(0, marker_mm, points.shape) if marker_mm else points
    boards, marks, start = {}, {}, []
    for camera in true:
        facing = looking_at(camera.center, np.array([0.0, 0.0, 250.0]))
        middle = facing.apply([0.0, 0.0, 300.0])
        board = RigidTransform(facing.rotation, middle - facing.rotation @ [100.0, 62.5, 0.0])
        pixels = camera.project(board.apply(BOARD.points))
        pixels = pixels + rng.normal(0, corner_sd_px, pixels.shape)
        corners = Corners(np.arange(54), pixels, 0.4, f"{camera.name}.jpg")
        boards[camera.name] = SeenBoard(BOARD, corners, board)
        seen = camera.project(placed)
        ids = np.flatnonzero(camera.intrinsics.contains(seen))
        noisy = seen[ids] + rng.normal(0, mark_sd_px, (len(ids), 2))
        marks[camera.name] = MarkerObservation(ids, noisy)
        known = _calibrated(camera.intrinsics, lens_sd, rng)
        rough = board @ board_pose(known, BOARD.points, pixels).inverse()
        start.append(Camera(camera.name, known, rough))
    observed = {name: board.observation for name, board in boards.items()}
    known = RigObservations(points, observed, marks, Tolerances(marker_mm))
    return Rig(true, tuple(start), known, boards)


def _calibrated(intrinsics: Intrinsics, sd: Floats | None, rng: np.random.Generator) -> Intrinsics:
    if sd is None:
        return intrinsics
    matrix, error = intrinsics.matrix.copy(), rng.normal(0, sd)
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += error
    covariance = np.zeros((12, 12))
    covariance[:4, :4] = np.diag(np.square(sd))
    return replace(intrinsics, matrix=matrix, covariance=covariance)


def poses() -> list[RigidTransform]:
    """Ten of a body amid the cameras."""
    rng, middle = np.random.default_rng(0), np.array([0.0, 0.0, 250.0])
    return [
        RigidTransform.from_rotvec(rng.uniform(-0.6, 0.6, 3), middle + rng.uniform(-40, 40, 3))
        for _ in range(10)
    ]


def cost_mm(estimated: tuple[Camera, ...], true: tuple[Camera, ...]) -> float:
    """What wrong cameras cost the body's position, RMS."""
    shifts = body_cost(estimated, true, paper_body(), poses())
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1))))


def squared_errors(
    fitted: CameraFit, seeds: int, lens_sd: Floats, at: list[RigidTransform]
) -> tuple[float, float]:
    """Of camera poses and of the body's position, over their stated variances: 1 if honest."""
    of_cameras, of_body = [], []
    for seed in range(seeds):
        noisy = rig(np.random.default_rng(seed), marker_mm=0.1, lens_sd=lens_sd)
        fit = fitted(noisy.start, noisy.observations, None)
        for camera, true in zip(fit.cameras, noisy.true, strict=True):
            error = true.world_from_camera.difference(camera.world_from_camera)
            of_cameras.append(error @ np.linalg.solve(camera.pose_covariance, error) / 6)
        shift = body_cost(fit.cameras, noisy.true, paper_body(), at)
        sd, _ = body_pose_sd(fit.cameras, paper_body(), at, fit.covariance)
        of_body.append(np.mean(np.sum(shift**2, axis=1) / sd**2))
    return float(np.mean(of_cameras)), float(np.mean(of_body))


def check_cross_covariance(fitted: CameraFit) -> None:
    """Each camera by itself says nearly what all say together; pose and lens apart, far more."""
    noisy, body = rig(np.random.default_rng(3), lens_sd=LENS_SD), paper_body()
    fit = fitted(noisy.start, noisy.observations, None)
    together, _ = body_pose_sd(fit.cameras, body, poses(), fit.covariance)
    single, _ = body_pose_sd(fit.cameras, body, poses())
    assert np.all((single / together > 0.5) & (single / together < 1.5))
    apart = tuple(replace(camera, pose_intrinsics_covariance=None) for camera in fit.cameras)
    assert np.all(body_pose_sd(apart, body, poses())[0] > 3 * together)

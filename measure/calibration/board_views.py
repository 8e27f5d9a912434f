"""Lens models, and views of a flat board: its pose in each, and cameras fitted to them.

Unknown are the free lens parameters of all cameras, the poses of all but the first, whose frame is
the world, and one pose of the board an instant. One camera by itself is the simplest case.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from measure.arrays import Floats, Ints, rms_length
from measure.calibration.boards import Board, Corners
from measure.errors import CalibrationError
from measure.estimation.least_squares import LeastSquaresSolution, solve
from measure.estimation.losses import Huber
from measure.estimation.rig_model import RigProblem, RigState, Views
from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics, Projection

_NAMES: dict[Projection, str] = {
    "pinhole": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "fisheye": "fx fy cx cy k1 k2 k3 k4",
}


@dataclass(frozen=True)
class LensModel:
    """Which of fx fy cx cy and the distortion coefficients are free; the rest stay as given."""

    name: str
    free: tuple[int, ...]
    projection: Projection = "pinhole"

    @property
    def parameters(self) -> str:
        """Names of the free parameters."""
        names = _NAMES[self.projection].split()
        return " ".join(names[i] for i in self.free)


LENS_MODELS: tuple[LensModel, ...] = (
    LensModel("pinhole", (0, 1, 2, 3)),
    LensModel("radial1", (0, 1, 2, 3, 4)),
    LensModel("radial2", (0, 1, 2, 3, 4, 5)),
    LensModel("tangential", (0, 1, 2, 3, 4, 5, 6, 7)),
    LensModel("brown", (0, 1, 2, 3, 4, 5, 6, 7, 8)),
)
"""From the stiffest to the freest; each contains the one before."""
MODELS_OF: dict[Projection, tuple[LensModel, ...]] = {
    "pinhole": LENS_MODELS,
    "fisheye": tuple(LensModel(f"fisheye{k}", tuple(range(4 + k)), "fisheye") for k in range(5)),
}


_FISHEYE_WIDTHS_RAD = (0.6, 0.9, 1.3, 1.8, 2.4, 3.1)
"""Angles over the image's longer side that are tried to begin with."""
_START_VIEWS = 8  # Most views that they are tried on


def board_pose(intrinsics: Intrinsics, points: Floats, pixels: Floats) -> RigidTransform:
    """Pose camera_from_board from n >= 4 points (n, 3) and pixels (n, 2): of two the better one."""
    bearings = intrinsics.unproject(pixels)
    if not np.isfinite(bearings).all():
        raise CalibrationError("the board's corners lie where the lens sees nothing")
    ideal = bearings[:, :2] / bearings[:, 2:]
    places, seen = np.ascontiguousarray(points), np.ascontiguousarray(ideal)
    methods = [cv2.SOLVEPNP_IPPE if np.allclose(points[:, 2], 0.0) else cv2.SOLVEPNP_SQPNP]
    # SQPNP misses the best pose of four points now and then.
    methods += [cv2.SOLVEPNP_AP3P] * (len(points) == 4)
    solved = [
        cv2.solvePnPGeneric(places, seen, np.eye(3), np.zeros(0), flags=method)[1:3]
        for method in methods
    ]
    poses = [
        RigidTransform.from_rotvec(np.ravel(turn), np.ravel(shift))
        for turns, shifts in solved
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    errors = [_rms(intrinsics, pose, points, pixels) for pose in poses]
    if not errors or not np.isfinite(np.min(errors)):
        raise CalibrationError("no pose of the board explains its corners in the picture")
    return poses[int(np.argmin(errors))]


def unmirrored(board: Board, corners: Corners, lens: Intrinsics) -> Corners:
    """The view as it was before someone mirrored the picture left to right."""
    pixels = corners.pixels.copy()
    pixels[:, 0] = lens.size_wh[0] - 1 - pixels[:, 0]
    columns = int(np.sum(board.points[:, 1] == board.points[0, 1]))
    rows = len(board.points) // columns
    if len(corners.ids) != len(board.points):
        return replace(corners, pixels=pixels)
    # A mirrored chessboard was numbered along x the wrong way round; which end depends on colours.
    numbers = np.arange(len(board.points)).reshape(rows, columns)
    flipped = numbers[::-1] if rows % 2 == 0 and columns % 2 == 1 else numbers[:, ::-1]
    return replace(corners, pixels=pixels, ids=corners.ids[flipped.ravel()])


def _rms(intrinsics: Intrinsics, pose: RigidTransform, points: Floats, pixels: Floats) -> float:
    error = intrinsics.project(pose.apply(points)) - pixels
    value = rms_length(error)
    return value if np.isfinite(value) else np.inf


def start_intrinsics(
    size_wh: tuple[int, int],
    points: Floats,
    views: tuple[Corners, ...],
    projection: Projection = "pinhole",
) -> Intrinsics:
    """Image centre, and focal length by the views; CalibrationError if no fisheye explains them."""
    if projection == "pinhole":
        return _start_pinhole(size_wh, points, views)
    tried = [
        Intrinsics(size_wh, _plain_matrix(size_wh, max(size_wh) / width), model="fisheye")
        for width in _FISHEYE_WIDTHS_RAD
    ]
    few = views[:: -(-len(views) // _START_VIEWS)]
    errors = [_typical_rms(lens, points, few) for lens in tried]
    if not np.isfinite(min(errors)):
        raise CalibrationError("no fisheye lens explains the board's corners")
    return tried[int(np.argmin(errors))]


def _typical_rms(lens: Intrinsics, points: Floats, views: tuple[Corners, ...]) -> float:
    """Median over views of the RMS in px with the best pose; infinite if one has none."""
    try:
        poses = [board_pose(lens, points[view.ids], view.pixels) for view in views]
    except CalibrationError:
        return np.inf
    pairs = zip(poses, views, strict=True)
    return float(np.median([_rms(lens, pose, points[v.ids], v.pixels) for pose, v in pairs]))


def _plain_matrix(size_wh: tuple[int, int], focal: float) -> Floats:
    """The camera matrix of square pixels and a principal point in the image's centre."""
    x, y = (np.asarray(size_wh, dtype=np.float64) - 1) / 2
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1.0]])


def _start_pinhole(
    size_wh: tuple[int, int], points: Floats, views: tuple[Corners, ...]
) -> Intrinsics:
    """By the views' homographies.

    Zhang 2000, equation 3, for square pixels and a known principal point: every homography gives
    two equations linear in 1 / f^2.
    """
    centre = (np.asarray(size_wh, dtype=np.float64) - 1) / 2
    top, bottom = 0.0, 0.0
    for view in views:
        H, _ = cv2.findHomography(points[view.ids, :2], view.pixels - centre)
        h = np.asarray(H, dtype=np.float64)
        h = h / np.linalg.norm(h[:, :2])
        a, b = h[:2, 0], h[:2, 1]
        for left, right in (
            (a @ b, -h[2, 0] * h[2, 1]),
            (a @ a - b @ b, h[2, 1] ** 2 - h[2, 0] ** 2),
        ):
            top, bottom = top + float(left * left), bottom + float(left * right)
    focal = float(np.sqrt(top / bottom)) if bottom > 0 else 1.2 * max(size_wh)
    focal = float(np.clip(focal, 0.3 * max(size_wh), 10 * max(size_wh)))
    return Intrinsics(size_wh, _plain_matrix(size_wh, focal))


def fit_boards(
    points: Floats,
    cameras: tuple[Camera, ...],
    world_from_board: RigidTransform,
    views: Sequence[Mapping[int, Corners]],
    sds_px: Sequence[float],
    free: Sequence[Sequence[int]],
    huber: float,
) -> tuple[LeastSquaresSolution[RigState], list[Floats]]:
    """Fit cameras, and poses of a board; the first camera's pose is held, for it is the world.

    Args:
        points: (k, 3) the board's corners, mm.
        cameras: to start with.
        world_from_board: (f,) to start with, one an instant.
        views: of each camera, by the number of the instant.
        sds_px: of each camera, of a corner's coordinate.
        free: of each camera, which lens parameters are unknown.
        huber: how far the robust loss reaches in standard deviations; squares if infinite.

    Returns:
        The solution, and by camera what is left of its corners (n, 2) px.
    """
    seen = [
        Views(
            number,
            np.repeat([*mine], [len(view.ids) for view in mine.values()]),
            np.concatenate([view.ids for view in mine.values()]),
            np.concatenate([view.pixels for view in mine.values()]),
            np.eye(2) / sd_px,
        )
        for number, (mine, sd_px) in enumerate(zip(views, sds_px, strict=True))
    ]
    unknown = {
        f"camera {camera.name}": np.array([*range(6 * (number > 0)), *(6 + k for k in own)], int)
        for number, (camera, own) in enumerate(zip(cameras, free, strict=True))
    }
    start = RigState(cameras, world_from_board, {"points": points})
    problem = RigProblem(start, seen, unknown, {}, own_poses=True)
    solution = solve(problem.linearise, problem.step, start, Huber(huber))
    return solution, problem.residuals_px(solution.state)


@dataclass(frozen=True, eq=False)
class SingleCameraFit:
    """A lens fitted to board views."""

    intrinsics: Intrinsics
    residuals: Floats  # (n, 2) px, observed minus predicted
    view_of: Ints  # (n,) which view each residual belongs to
    sd_px: float  # standard deviation of a corner coordinate, from the residuals

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths (OpenCV's reprojection error)."""
        return rms_length(self.residuals)

    def view_rms_px(self) -> Floats:
        """The same for each view (v,)."""
        squares = np.sum(self.residuals**2, axis=1)
        return np.sqrt(np.bincount(self.view_of, squares) / np.bincount(self.view_of))


def fit_lens(
    start: Intrinsics,
    points: Floats,
    views: tuple[Corners, ...],
    model: LensModel,
    huber: float = np.inf,
) -> SingleCameraFit:
    """Fit the free lens parameters and all board poses to corners (k, 3) mm, from a start."""
    poses = RigidTransform.stack([board_pose(start, points[v.ids], v.pixels) for v in views])
    camera, seen = Camera("", start, RigidTransform.identity()), dict(enumerate(views))
    solution, left = fit_boards(points, (camera,), poses, [seen], [1.0], [model.free], huber)
    sd = float(np.sqrt(solution.variance_factor))
    covariance = np.zeros((12, 12))
    covariance[np.ix_(model.free, model.free)] = solution.covariance * max(
        sd**2, solution.clustered_factor
    )
    return SingleCameraFit(
        replace(solution.state.cameras[0].intrinsics, covariance=covariance),
        left[0],
        solution.linearised.groups[0].instant,
        sd,
    )

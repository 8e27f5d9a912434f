"""Boards that cameras see: their poses relative to each other, or the frame of a board at rest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from measure.arrays import Bytes, Floats, Ints, rms_length
from measure.calibration.board_views import board_pose, fit_boards, unmirrored
from measure.calibration.boards import Board, Corners, same_after
from measure.calibration.intrinsics import LensCalibration
from measure.errors import CalibrationError
from measure.estimation.expected_accuracy import by_each_calibration, pose_by_views
from measure.estimation.least_squares import LeastSquaresSolution
from measure.estimation.losses import HUBER_SIGMAS
from measure.estimation.rig_model import RigState
from measure.geometry import RigidTransform, UncertainTransform, chart_jacobian
from measure.limits import CLEAR_RATIO
from measure.model import Camera, Intrinsics

_MIN_COMMON = 3
_SAME_SHARE, _OTHER_RAD = 0.02, 0.5
"""Views agree about a camera's pose if they differ by no more than this share of the board's
diagonal, and alone about it if they differ so much more about any pose that is so far from it."""
_APART_SHARE = 0.1  # Views that disagree by more were not taken together
_MOST_LOST = 10  # Pictures at a beginning, by which numbers may be off
_NOT_TOGETHER = "do pictures (video frames) of one number show one instant?"
_MIRRORED = (
    "its pictures are mirrored, or those of the others are, for in a mirror they agree: switch off "
    "mirror (selfie) mode, and take them again"
)
_ONE_INSTANT_PX = 3.0  # Cameras that miss common views by more than this did not take them together


def fit_common_views(
    board: Board, lenses: Mapping[str, LensCalibration]
) -> tuple[tuple[Camera, ...], Floats, Floats]:
    """Fit all cameras, lenses included, with the first camera as the world.

    Pictures of one instant carry the same number in their names, or are frames of that number. Also
    gives the board's corners in the world at all instants (n, 3) mm, and the covariance of all
    cameras together (see `RigFit`): it describes the rig's shape alone, without a rigid motion of
    all positions where the board was.
    CalibrationError: a camera shares fewer than three views with those already placed, its pictures
    contradict the others', or the views do not tell how a board was turned that looks the same
    after a turn.
    """
    views = {
        name: {instant_of(v.source): v for v in lens.views.views} for name, lens in lenses.items()
    }
    cameras, boards = _start(board, lenses, views)
    order = {instant: number for number, instant in enumerate(sorted(boards))}
    seen = [
        {order[instant]: view for instant, view in sorted(views[name].items())} for name in lenses
    ]
    poses = RigidTransform.stack([boards[instant] for instant in order])
    free = [lens.model.free for lens in lenses.values()]
    sds_px = [lens.fit.sd_px for lens in lenses.values()]
    solution, left = fit_boards(board.points, cameras, poses, seen, sds_px, free, HUBER_SIGMAS)
    poses = solution.state.poses
    corners = np.einsum("fij,nj->fni", poses.rotation, board.points) + poses.translation[:, None]
    points = corners.reshape(-1, 3)
    found, joint = _answer(solution, left, free, points)
    _check_instants(found, lenses)
    return found, points, joint


def _check_instants(cameras: tuple[Camera, ...], lenses: Mapping[str, LensCalibration]) -> None:
    worst = max(cameras, key=lambda camera: camera.reprojection_rms_px or 0.0)
    missed_px, alone_px = worst.reprojection_rms_px or 0.0, lenses[worst.name].fit.rms_px
    if missed_px > alone_px + _ONE_INSTANT_PX:
        raise CalibrationError(
            f"camera {worst.name}: misses the common views by {missed_px:.1f} px, by itself by "
            f"{alone_px:.1f} px: {_NOT_TOGETHER}"
        )


def instant_of(source: str) -> int:
    """The last number in a picture's name, or that of a video's frame."""
    numbers = re.findall(r"\d+", re.sub(r"\.\w+$", "", source))
    if not numbers:
        raise CalibrationError(f"{source}: common views need a number in the name of each picture")
    return int(numbers[-1])


def _start(
    board: Board, lenses: Mapping[str, LensCalibration], views: Mapping[str, dict[int, Corners]]
) -> tuple[tuple[Camera, ...], dict[int, RigidTransform]]:
    """Camera after camera, by the board poses it shares with those placed before.

    Views of a board that looks the same after a turn are renumbered to agree with those before.
    """
    placed: dict[str, Camera] = {}
    boards: dict[int, RigidTransform] = {}
    waiting = list(lenses)
    while waiting:
        name = max(waiting, key=lambda n: len(views[n].keys() & boards.keys()))
        if not placed:
            name = waiting[0]
        waiting.remove(name)
        lens, mine = lenses[name].intrinsics, views[name]
        from_board = {i: board_pose(lens, board.points[v.ids], v.pixels) for i, v in mine.items()}
        common = sorted(from_board.keys() & boards.keys())
        if placed and len(common) < _MIN_COMMON:
            raise CalibrationError(_unconnected(views, [*placed], name, len(common)))
        pose = RigidTransform.identity()
        if placed:
            pairs = [(boards[i], from_board[i]) for i in common]
            try:
                pose, turned = _agreed_pose(board, pairs, name)
            except CalibrationError:
                if _agree_in_a_mirror(board, lens, [(boards[i], mine[i]) for i in common]):
                    raise CalibrationError(f"camera {name}: {_MIRRORED}") from None
                if by := _shift(board, boards, from_board):
                    message = f"camera {name}: {_NOT_TOGETHER} {_shifted(by)}"
                    raise CalibrationError(message) from None
                raise
            for instant, turn in zip(common, turned, strict=True):
                ids = board.turns[turn][mine[instant].ids]
                mine[instant] = replace(mine[instant], ids=ids)
        placed[name] = Camera(name, lens, pose)
        boards |= {i: pose @ p for i, p in from_board.items() if i not in boards}
    return tuple(placed[name] for name in lenses), boards


def _agreed_pose(
    board: Board,
    pairs: list[tuple[RigidTransform, RigidTransform]],
    name: str,
    apart_share: float = _APART_SHARE,
) -> tuple[RigidTransform, Ints]:
    """The pose of a camera on which most of its views agree, and each view's number of turns."""
    turns = [_turned(board.points, turn) for turn in board.turns]
    guesses = RigidTransform.stack(
        [known @ t @ seen.inverse() for known, seen in pairs for t in turns]
    )
    here = np.stack([seen.apply(board.points) for _, seen in pairs])
    there = np.stack([[(known @ t).apply(board.points) for t in turns] for known, _ in pairs])
    placed = np.einsum("gab,fnb->gfna", guesses.rotation, here)
    placed = placed + guesses.translation[:, None, None]
    apart = np.linalg.norm(placed[:, :, None] - there, axis=-1).mean(axis=-1)
    misfit = np.median(apart.min(axis=2), axis=1)
    best = int(np.argmin(misfit))
    cosine = (np.einsum("gab,ab->g", guesses.rotation, guesses.rotation[best]) - 1) / 2
    other = np.min(misfit[cosine < np.cos(_OTHER_RAD)], initial=np.inf)
    diagonal = float(np.linalg.norm(np.ptp(board.points, axis=0)))
    if misfit[best] > apart_share * diagonal:
        raise CalibrationError(
            f"camera {name}: sees the board {misfit[best]:.0f} mm from where the others see it: "
            f"{_NOT_TOGETHER}"
        )
    if len(turns) > 1 and other < max(_SAME_SHARE * diagonal, CLEAR_RATIO * misfit[best]):
        raise CalibrationError(
            f"camera {name}: {same_after(board)}, and the common views fit two poses of the "
            "camera: tilt the board to other sides between pictures, or use one with an odd and an "
            "even number of squares, or a ChArUco board"
        )
    return guesses[best], np.argmin(apart[best], axis=1)


def _unconnected(
    views: Mapping[str, dict[int, Corners]], placed: Sequence[str], name: str, common: int
) -> str:
    """Why a camera cannot be placed: it shares too little with all, or a group with the others."""
    group, instants = [name], {*views[name]}
    for other in views:
        if other not in (*placed, *group) and len(views[other].keys() & instants) >= _MIN_COMMON:
            group.append(other)
            instants |= views[other].keys()
    needed = f"at least {_MIN_COMMON} are needed"
    if len(group) == 1 or len(placed) == 1:
        return f"camera {name}: shares {common} board views with the other cameras, {needed}"
    return (
        f"the cameras see the board in two groups: {' and '.join(placed)} share views, and so do "
        f"{' and '.join(group)}, but a camera of one group shares {common or 'none'} with the "
        f"other ({needed}): show the board to a camera of each at once"
    )


def _shift(
    board: Board, boards: Mapping[int, RigidTransform], seen: Mapping[int, RigidTransform]
) -> int:
    """By how many numbers a camera's pictures are off, if they agree with others then; else 0."""
    for by in (sign * count for count in range(1, _MOST_LOST + 1) for sign in (1, -1)):
        pairs = [(boards[i + by], pose) for i, pose in seen.items() if i + by in boards]
        if len(pairs) > _MIN_COMMON:
            try:
                _agreed_pose(board, pairs, "", _SAME_SHARE)
            except CalibrationError:
                continue
            return by
    return 0


def _shifted(by: int) -> str:
    way, lost = ("after", "it") if by > 0 else ("before", "another camera")
    which = f"the one {f'{abs(by)} numbers ' if abs(by) > 1 else ''}{way} it"
    return (
        f"They do when each of its pictures is used as {which}: {lost} lost {abs(by)} at the "
        "beginning; give its pictures those numbers, or take all again"
    )


def _agree_in_a_mirror(
    board: Board, lens: Intrinsics, views: Sequence[tuple[RigidTransform, Corners]]
) -> bool:
    """Whether a camera's views agree with the board's poses by others once they are mirrored."""
    before = [(known, unmirrored(board, view, lens)) for known, view in views]
    try:
        pairs = [(known, board_pose(lens, board.points[v.ids], v.pixels)) for known, v in before]
        _agreed_pose(board, pairs, "")
    except CalibrationError:
        return False
    return True


def _turned(points: Floats, turn: Ints) -> RigidTransform:
    """The turn of a flat board about its middle that takes each corner to where another was."""
    middle = points.mean(axis=0)
    (x, y, _), (u, v, _) = points[0] - middle, points[turn[0]] - middle
    angle = np.arctan2(x * v - y * u, x * u + y * v)
    turned = RigidTransform.from_rotvec(np.array([0.0, 0.0, angle]))
    return RigidTransform(turned.rotation, middle - turned.rotation @ middle)


def _answer(
    solution: LeastSquaresSolution[RigState],
    left: Sequence[Floats],
    free: Sequence[Sequence[int]],
    points: Floats,
) -> tuple[tuple[Camera, ...], Floats]:
    """The cameras with their covariances, for positions (n, 3) in their view."""
    cameras, lenses = solution.state.cameras, [np.array(own) for own in free]
    size = 6 + len(solution.covariance)
    # The first camera is the world: of its pose, in the first rows, nothing is unknown.
    covariance = np.zeros((size, size))
    factor = max(solution.variance_factor, solution.clustered_factor, 1.0)
    covariance[6:, 6:] = factor * solution.covariance
    shape, _, _ = shape_errors(cameras, lenses, points)
    covariance = shape @ covariance @ shape.T
    rows = zip(cameras, columns_of(lenses), lenses, left, strict=True)
    out = tuple(
        camera.with_covariance(covariance[np.ix_(own, own)], lens, rms_length(residuals))
        for camera, own, lens, residuals in rows
    )
    return out, covariance


def columns_of(free: Sequence[Ints]) -> list[Ints]:
    """Where the pose and free lens parameters of each camera stand, camera after camera."""
    ends = np.cumsum([6 + len(own) for own in free])
    return np.split(np.arange(ends[-1]), ends[:-1])


def shape_errors(
    cameras: Sequence[Camera], free: Sequence[Ints], points: Floats, with_scale: bool = False
) -> tuple[Floats, Floats, Floats]:
    """What errors of cameras and free lens parameters (p,) do to the rig's shape, and to the world.

    With the first camera as the world, its errors move all positions alike, which covariances of
    single cameras cannot express. Here the world moves with the positions (n, 3) that two cameras
    see, by the rigid motion that fits them best (Baarda 1973, Publications on Geodesy 5.1);
    `with_scale` by the similarity, whose scale is about the world's origin.

    Returns:
        (p, p) that takes errors to those of the shape alone; (6, p) or (7, p) to the world's
        motion; and (p, 6) or (p, 7), what such a motion does to the cameras.
    """
    columns = columns_of(free)
    size = sum(map(len, columns))
    normal, moved = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, size))
    seen_by = np.zeros(len(points), dtype=np.int64)
    for camera, own, rows in zip(cameras, free, columns, strict=True):
        pixels, by_world, by_pose, by_lens = camera.project_with_jacobians(points)
        seen = np.flatnonzero(camera.intrinsics.contains(pixels))
        back = by_world[seen].transpose(0, 2, 1)
        normal[seen] += back @ by_world[seen]
        by_camera = np.concatenate([by_pose[seen], by_lens[seen][..., own]], axis=2)
        moved[np.ix_(seen, np.arange(3), rows)] += back @ by_camera
        seen_by[seen] += 1
    both = seen_by > 1
    # A camera that moves one way sees all positions move the other way.
    placed = -np.linalg.solve(normal[both], moved[both]).reshape(-1, size)
    motions = _motions(points[both], with_scale)
    world = np.linalg.pinv(motions.reshape(len(placed), -1)) @ placed
    moves = np.zeros((size, len(world)))
    for camera, rows in zip(cameras, columns, strict=True):
        moves[rows[:3]] = _motions(camera.center, with_scale)
        moves[rows[3:6], 3:6] = np.eye(3)
    return np.eye(size) - moves @ world, world, moves


def _motions(points: Floats, with_scale: bool) -> Floats:
    """How points (..., 3) follow the world's motion (..., 3, 6), or its scale too (..., 3, 7)."""
    rigid = chart_jacobian(points)
    return np.concatenate([rigid, points[..., None]], axis=-1) if with_scale else rigid


_View = tuple[Camera, Corners]
_UP_FROM_BOARD = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
_LEAST_SD_PX = 0.05  # Corners are never more exact, however few there are
_WRONG_PX = 5.0  # Corners further off than this are no noise: the board moved, or a camera did


def board_frame(
    board: Board, cameras: Sequence[Camera], pictures: Mapping[str, Bytes]
) -> UncertainTransform:
    """The frame world_from_board of a board that lies still, its z axis towards the viewer.

    Its origin is the board's and its x axis is printed; y runs against the board's own, so that z
    comes out of the paper. Least squares over the corners in all pictures (BGR by camera name, of
    one instant); the covariance holds the corners' scatter and what the cameras' own uncertainties
    do to it. CalibrationError: the board is in no picture, looks the same after a turn, or the
    pictures contradict each other.
    """
    if len(board.turns) > 1:
        raise CalibrationError(
            f"{same_after(board)}, so two frames are possible: take a ChArUco board, or one "
            "with an odd and an even number of squares"
        )
    grays = {
        n: np.asarray(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY), np.uint8) for n, p in pictures.items()
    }
    looked = [(c, board.find(grays[c.name], c.name)) for c in cameras if c.name in grays]
    views = [(camera, corners) for camera, corners in looked if corners is not None]
    if not views:
        raise CalibrationError(f"no board found in any of {len(pictures)} pictures")
    pose = _fit(board, views)
    off = [float(rms_length(_residuals(board, [v], pose).reshape(-1, 2))) for v in views]
    if max(off) > _WRONG_PX:
        worst = views[int(np.argmax(off))][0].name
        raise CalibrationError(
            f"camera {worst}: the board's corners lie {max(off):.1f} px from where the other "
            "pictures put them: did the board or a camera move, or is square_mm wrong?"
        )
    return UncertainTransform(pose @ _UP_FROM_BOARD.inverse(), _covariance(board, views, pose))


def _fit(board: Board, views: Sequence[_View]) -> RigidTransform:
    by_one = (
        camera.world_from_camera
        @ board_pose(camera.intrinsics, board.points[seen.ids], seen.pixels)
        for camera, seen in views
    )
    start = min(by_one, key=lambda pose: np.sum(np.abs(_residuals(board, views, pose))))

    def residuals(delta: Floats) -> Floats:
        return _residuals(board, views, start.perturb(delta))

    scale = [1.0] * 3 + [0.01] * 3
    solved = least_squares(residuals, np.zeros(6), jac="3-point", x_scale=scale, loss="soft_l1")
    return start.perturb(solved.x)


def _residuals(board: Board, views: Sequence[_View], pose: RigidTransform) -> Floats:
    parts = [c.project(pose.apply(board.points[v.ids])) - v.pixels for c, v in views]
    return np.nan_to_num(np.concatenate(parts).ravel(), nan=1e3)


def _covariance(board: Board, views: Sequence[_View], pose: RigidTransform) -> Floats:
    """By the corners' scatter, and by the cameras' covariances through the normal equations."""
    placed = [(camera, pose.apply(board.points[seen.ids])) for camera, seen in views]
    by_corners, by_cameras = pose_by_views(placed, pose)
    off = _residuals(board, views, pose)
    variance = max(float(off @ off) / max(len(off) - 6, 1), _LEAST_SD_PX**2)
    return variance * by_corners + by_each_calibration([c for c, _ in views], by_cameras)

"""Where the cameras stand, all of them at once.

Least squares over every camera's pose and lens, the marker positions and the board
poses. What is known beforehand enters with its uncertainty: the lens with the covariance of its own
fit, a marker with the tolerance of its post, a board with the tolerance of its holder. Corners and
marks are weighted by standard deviations estimated from the residuals (variance components), and
Huber's loss bounds the influence of single wrong marks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats, rms_length
from measure.estimation.least_squares import LeastSquaresSolution, root_information, solve
from measure.estimation.losses import Huber
from measure.estimation.rig_model import RigProblem, RigState, Views
from measure.geometry import RigidTransform
from measure.limits import MAX_STEPS
from measure.model import (
    BoardObservation,
    Camera,
    MarkerObservation,
    RigFit,
    RigObservations,
    Tolerances,
)

_HUBER = Huber(3.0)
MIN_SD_PX = 0.02
START_CORNER_SD_PX = 0.1
START_MARK_SD_PX = 0.5
_CORNERS, _MARKS = 0, 1  # The two kinds of observation, each with its own standard deviation


@dataclass(frozen=True, eq=False, kw_only=True)
class JointRigFit(RigFit):
    """All cameras fitted at once, to boards and marks."""

    state: RigState  # the same cameras, and where markers (first) and boards came out
    log_likelihood: float  # restricted, up to a constant: compares tolerances and weights


def fit_rig(
    start: tuple[Camera, ...],
    observations: RigObservations,
    corner_sd_px: float | None = None,
    mark_sd_px: float | None = None,
) -> JointRigFit:
    """Fit all cameras jointly, a lens within its covariance; without one it stays as it is."""
    problem = _problem(start, observations)
    state = problem.start
    sds = np.array([corner_sd_px or START_CORNER_SD_PX, mark_sd_px or START_MARK_SD_PX])
    fixed = np.array([corner_sd_px is not None, mark_sd_px is not None])
    for _ in range(MAX_STEPS):
        views = [replace(seen, root=np.eye(2) / sds[_kind(seen)]) for seen in problem.views]
        problem = replace(problem, views=views)
        solution = solve(problem.linearise, problem.step, state, _HUBER)
        state = solution.state
        estimated = _standard_deviations(solution, problem, sds)
        if np.all(fixed | (np.abs(estimated / sds - 1) < 1e-3)):
            break
        sds = np.where(fixed, sds, estimated)
    return _answer(solution, problem, sds, observations.tolerances)


def located_by_marks(camera: Camera, points: Floats, marks: MarkerObservation) -> Camera:
    """The camera with its pose fitted robustly to marks of exact points (k, 3), its lens held."""
    held = replace(camera, intrinsics=replace(camera.intrinsics, covariance=None))
    seen = RigObservations(points, marks={camera.name: marks}, tolerances=Tolerances(0.0))
    fitted = fit_rig((held,), seen).cameras[0]
    return replace(camera, world_from_camera=fitted.world_from_camera)


def _problem(start: tuple[Camera, ...], observations: RigObservations) -> RigProblem:
    """What is seen and known beforehand; the first pose is the world's, which carries markers."""
    tolerances, markers = observations.tolerances, observations.markers
    views, points, poses = list[Views](), [markers], [RigidTransform.identity()]
    free = {f"camera {camera.name}": camera.free for camera in start}
    priors, values = dict[tuple[str, ...], Floats](), dict[str, Floats]()
    for number, camera in enumerate(start):
        name, lens = camera.name, camera.intrinsics.covariance
        if lens is not None and len(own := camera.intrinsics.free):
            root = root_information(lens[np.ix_(own, own)])
            priors[f"camera {name}",] = np.pad(root, ((0, 0), (6, 0)))
        if (board := observations.boards.get(name)) is not None:
            ids = sum(map(len, points)) + np.arange(len(board.points))
            views.append(Views(number, np.full(len(ids), len(poses)), ids, board.pixels))
            points.append(board.points)
            poses.append(board.world_from_board)
        if (marks := observations.marks.get(name)) is not None and len(marks.ids):
            none = np.zeros(len(marks.ids), dtype=np.int64)
            views.append(Views(number, none, marks.ids, marks.pixels))
            if marks.searched and tolerances.common_px > 0:
                views[-1] = replace(views[-1], offset=none)
                values[f"offsets {name}"] = np.zeros((1, 2))
                free[f"offsets {name}"] = np.arange(2)
                priors[f"offsets {name}",] = np.eye(2) / tolerances.common_px
    if tolerances.marker_mm > 0 and len(markers):
        free["points"] = np.arange(markers.size)
        priors["points",] = np.eye(markers.size) / tolerances.marker_mm
    board_sd = np.repeat([tolerances.board_mm, np.deg2rad(tolerances.board_deg)], 3)
    if np.any(board_sd > 0) and len(poses) > 1:
        free["poses"] = np.arange(6, 6 * len(poses))
        priors["poses",] = np.diag(np.tile(1 / np.maximum(board_sd, 1e-9), len(poses) - 1))
    values["points"] = np.concatenate(points)
    return RigProblem(RigState(start, RigidTransform.stack(poses), values), views, free, priors)


def _kind(seen: Views) -> int:
    return _CORNERS if seen.pose[0] else _MARKS


def _standard_deviations(
    solution: LeastSquaresSolution[RigState], problem: RigProblem, sds: Floats
) -> Floats:
    """Standard deviations of corners and marks from their residuals and redundancies.

    Variance components in Förstner's form: a class's squared residuals over its share of the
    degrees of freedom, the trace of (1 - leverage).
    """
    squares, redundancy = np.zeros(2), np.zeros(2)
    for group, seen in zip(solution.linearised.groups, problem.views, strict=True):
        lengths = np.linalg.norm(group.residuals, axis=1)
        weights = _HUBER.weights(lengths)
        P = solution.covariance_of(*group.by_block)
        leverage = np.einsum("nki,ij,nkj->n", group.by_shared, P, group.by_shared) * weights
        squares[_kind(seen)] += float(np.sum(weights * lengths**2))
        redundancy[_kind(seen)] += float(np.sum(2 - leverage))
    factor = np.where(redundancy > 1, squares / np.maximum(redundancy, 1), 1.0)
    return np.maximum(sds * np.sqrt(factor), MIN_SD_PX)


def _answer(
    solution: LeastSquaresSolution[RigState],
    problem: RigProblem,
    sds: Floats,
    tolerances: Tolerances,
) -> JointRigFit:
    state, left = solution.state, problem.residuals_px(solution.state)
    cameras = []
    for number, camera in enumerate(state.cameras):
        own = [r for r, seen in zip(left, problem.views, strict=True) if seen.camera == number]
        P, rms = solution.covariance_of(f"camera {camera.name}"), rms_length(np.concatenate(own))
        cameras.append(camera.with_covariance(P, camera.intrinsics.free, rms))
    return JointRigFit(
        cameras=tuple(cameras),
        covariance=solution.covariance_of(*(f"camera {camera.name}" for camera in cameras)),
        mark_sd_px=float(sds[_MARKS]),
        corner_sd_px=float(sds[_CORNERS]),
        mark_residuals={
            cameras[seen.camera].name: r
            for r, seen in zip(left, problem.views, strict=True)
            if _kind(seen) == _MARKS
        },
        state=replace(state, cameras=tuple(cameras)),
        log_likelihood=_log_likelihood(solution, problem, sds, tolerances),
    )


def _log_likelihood(
    solution: LeastSquaresSolution[RigState],
    problem: RigProblem,
    sds: Floats,
    tolerances: Tolerances,
) -> float:
    """Of the residuals, with the unknowns integrated out (up to a constant)."""
    spread = sum(seen.pixels.size * np.log(sds[_kind(seen)]) for seen in problem.views)
    if tolerances.board_mm > 0 and tolerances.board_deg > 0:
        one = np.log(tolerances.board_mm) + np.log(np.deg2rad(tolerances.board_deg))
        spread += len(problem.free.get("poses", ())) / 2 * one
    offsets = sum(len(own) for name, own in problem.free.items() if name.startswith("offsets"))
    if offsets:
        spread += offsets * np.log(tolerances.common_px)
    _, volume = np.linalg.slogdet(solution.covariance)
    return float(-0.5 * solution.cost - spread + 0.5 * volume)


_BOARD_MM = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_COMMON_PX = (0.2, 0.4)
"""Candidates for the offset common to the found marks of a picture, px. Zero is not among them:
light from above shifts the dots of all cameras upwards, which no residual shows."""
DEFAULT_COMMON_PX = 0.2  # Taken for that offset where no boards determine it
_PAST_PEAK_LOG_LIKELIHOOD = 10.0
"""The search ends at a candidate whose log likelihood is lower than the best by this."""


def fit_rig_with_boards(
    start: tuple[Camera, ...],
    observations: RigObservations,
    mark_sd_px: float | None = None,
    boards_stated: bool = False,
) -> tuple[JointRigFit, Tolerances]:
    """Fit the rig with the tolerances that make boards and markers most likely together.

    Restricted maximum likelihood (Patterson and Thompson 1971) over a fixed list of board
    tolerances, where none is stated, and over one of common offsets of found marks, where there are
    any. Without at least two cameras that see both there is nothing to learn from: the stated poses
    are taken as exact and the offset as it stands. Raises as `fit_rig`.
    """
    both = [
        n
        for n in observations.boards
        if n in observations.marks and len(observations.marks[n].ids) >= 3
    ]
    if len(both) < 2:
        return fit_rig(start, observations, mark_sd_px=mark_sd_px), observations.tolerances
    boards = [observations.tolerances]
    if not boards_stated:
        held = [held_within(observations.boards, mm) for mm in _BOARD_MM]
        boards = [replace(boards[0], board_mm=mm, board_deg=deg) for mm, deg in held]
    best = _likeliest(start, observations, boards, mark_sd_px)
    if any(marks.searched for marks in observations.marks.values()):
        offsets = [replace(best[1], common_px=px) for px in _COMMON_PX]
        best = _likeliest(start, observations, offsets, mark_sd_px)
        if len(boards) > 1:
            boards = [replace(b, common_px=best[1].common_px) for b in boards]
            best = _likeliest(start, observations, boards, mark_sd_px)
    return best


def held_within(
    boards: Mapping[str, BoardObservation], shift_mm: float | None, turn_deg: float | None = None
) -> tuple[float, float]:
    """How far boards may be shifted (mm) and turned (degrees) from where they are stated to be.

    Where only one of the two is stated, the other moves a board's rim as much; where neither is,
    the boards are exact.
    """
    if not boards:
        return 0.0, 0.0
    offsets = [b.points - b.points.mean(axis=0) for b in boards.values()]
    rim_mm = float(np.sqrt(np.mean(np.concatenate(offsets) ** 2) * 3))
    if shift_mm is None:
        shift_mm = rim_mm * float(np.deg2rad(turn_deg or 0.0))
    if turn_deg is None:
        turn_deg = float(np.rad2deg(shift_mm / rim_mm))
    return shift_mm, turn_deg


def _likeliest(
    start: tuple[Camera, ...],
    observations: RigObservations,
    candidates: list[Tolerances],
    mark_sd_px: float | None,
) -> tuple[JointRigFit, Tolerances]:
    best: tuple[JointRigFit, Tolerances] | None = None
    for tolerances in candidates:
        fit = fit_rig(start, replace(observations, tolerances=tolerances), mark_sd_px=mark_sd_px)
        if best is None or fit.log_likelihood > best[0].log_likelihood:
            best = fit, tolerances
        elif fit.log_likelihood < best[0].log_likelihood - _PAST_PEAK_LOG_LIKELIHOOD:
            break
    assert best is not None
    return best

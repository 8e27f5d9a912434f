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
from measure.calibration.least_squares import LeastSquaresSolution, solve
from measure.calibration.rig_problem import CORNERS, MARKS, RigProblem, RigState, lay_out
from measure.estimation.losses import Huber
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


@dataclass(frozen=True, eq=False, kw_only=True)
class JointRigFit(RigFit):
    """All cameras fitted at once, to boards and marks."""

    state: RigState  # the same cameras, and where markers and boards came out
    log_likelihood: float  # restricted, up to a constant: compares tolerances and weights


def fit_rig(
    start: tuple[Camera, ...],
    observations: RigObservations,
    corner_sd_px: float | None = None,
    mark_sd_px: float | None = None,
) -> JointRigFit:
    """Fit all cameras jointly, a lens within its covariance; without one it stays as it is."""
    layout = lay_out(start, observations)
    boards = {name: board.world_from_board for name, board in observations.boards.items()}
    offsets = {name: np.zeros(2) for name in layout.offsets}
    state = RigState(start, observations.markers, boards, offsets)
    sds = np.array([corner_sd_px or START_CORNER_SD_PX, mark_sd_px or START_MARK_SD_PX])
    fixed = np.array([corner_sd_px is not None, mark_sd_px is not None])
    for _ in range(MAX_STEPS):
        problem = RigProblem(start, observations, layout, sds)
        solution = solve(problem.linearise, problem.step, state, _HUBER)
        state = solution.state
        estimated = _standard_deviations(solution, problem)
        if np.all(fixed | (np.abs(estimated / sds - 1) < 1e-3)):
            break
        sds = np.where(fixed, sds, estimated)
    return _answer(solution, problem)


def located_by_marks(camera: Camera, points: Floats, marks: MarkerObservation) -> Camera:
    """The camera with its pose fitted robustly to marks of exact points (k, 3), its lens held."""
    held = replace(camera, intrinsics=replace(camera.intrinsics, covariance=None))
    seen = RigObservations(points, marks={camera.name: marks}, tolerances=Tolerances(0.0))
    fitted = fit_rig((held,), seen).cameras[0]
    return replace(camera, world_from_camera=fitted.world_from_camera)


def _standard_deviations(solution: LeastSquaresSolution[RigState], problem: RigProblem) -> Floats:
    """Standard deviations of corners and marks from their residuals and redundancies.

    Variance components in Förstner's form: a class's squared residuals over its share of the
    degrees of freedom, the trace of (1 - leverage).
    """
    squares, redundancy = np.zeros(2), np.zeros(2)
    for group, (_, kind) in zip(solution.linearised.groups, problem.labels(), strict=True):
        lengths = np.linalg.norm(group.residuals, axis=1)
        weights = _HUBER.weights(lengths)
        P = solution.covariance[np.ix_(group.columns, group.columns)]
        leverage = np.einsum("nki,ij,nkj->n", group.by_shared, P, group.by_shared) * weights
        squares[kind] += float(np.sum(weights * lengths**2))
        redundancy[kind] += float(np.sum(2 - leverage))
    factor = np.where(redundancy > 1, squares / np.maximum(redundancy, 1), 1.0)
    return np.maximum(problem.sds * np.sqrt(factor), MIN_SD_PX)


def _answer(solution: LeastSquaresSolution[RigState], problem: RigProblem) -> JointRigFit:
    layout, sds = problem.layout, problem.sds
    residuals: tuple[dict[str, Floats], dict[str, Floats]] = ({}, {})
    for (name, kind), group in zip(problem.labels(), solution.linearised.groups, strict=True):
        residuals[kind][name] = group.residuals * sds[kind]
    cameras = []
    for camera, columns, free in zip(
        solution.state.cameras, layout.cameras, layout.lens_free, strict=True
    ):
        P = solution.covariance[np.ix_(columns, columns)]
        own = [of_kind[camera.name] for of_kind in residuals if camera.name in of_kind]
        rms = rms_length(np.concatenate(own))
        cameras.append(camera.with_covariance(P, free, rms))
    used = sum(len(c) for c in layout.cameras)
    return JointRigFit(
        cameras=tuple(cameras),
        covariance=solution.covariance[:used, :used],
        mark_sd_px=float(sds[MARKS]),
        corner_sd_px=float(sds[CORNERS]),
        mark_residuals=residuals[MARKS],
        state=replace(solution.state, cameras=tuple(cameras)),
        log_likelihood=_log_likelihood(solution, problem),
    )


def _log_likelihood(solution: LeastSquaresSolution[RigState], problem: RigProblem) -> float:
    """Of the residuals, with the unknowns integrated out (up to a constant)."""
    spread = sum(
        group.residuals.size * np.log(problem.sds[kind])
        for group, (_, kind) in zip(solution.linearised.groups, problem.labels(), strict=True)
    )
    tolerances, layout = problem.observations.tolerances, problem.layout
    if tolerances.board_mm > 0 and tolerances.board_deg > 0:
        one = np.log(tolerances.board_mm) + np.log(np.deg2rad(tolerances.board_deg))
        spread += 3 * len(layout.boards) * one
    if layout.offsets:
        spread += 2 * len(layout.offsets) * np.log(tolerances.common_px)
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

"""Where the cameras stand: all of them at once, or one by one as the paper has it.

All at once: least squares over every camera's pose and lens, the marker positions and the board
poses. What is known beforehand enters with its uncertainty: the lens with the covariance of its own
fit, a marker with the tolerance of its post, a board with the tolerance of its holder. Corners and
marks are weighted by standard deviations estimated from the residuals (variance components), and
Huber's loss bounds the influence of single wrong marks.

One by one, equation 3: the board gives a rough pose, the markers refine it. The vector from the
camera to a marker, v_c2m, and the vector from the marker's image to the camera, v_i2c, must be
parallel. The paper writes v_c2m(k) / v_i2c(k) = |v_c2m| / |v_i2c| for k = 1, 2, 3; multiplied out,
because a quotient has no value where a component is zero, and divided by both lengths, that is
v_c2m / |v_c2m| - v_i2c / |v_i2c| = 0: three equations a marker, six unknowns a camera, solved by
Levenberg and Marquardt. The paper gives no errors. Here those of marks, lenses and marker places
travel through the equations (implicit differentiation of their optimum) into one covariance of all
cameras; the standard deviation of the marks comes from their residuals, pooled over the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats, Ints, rms_length
from measure.calibration.board_views import free_parameters, with_covariance
from measure.calibration.least_squares import Columns, Huber, LeastSquaresSolution, solve
from measure.calibration.rig_problem import (
    CORNERS,
    MARKS,
    BoardObservation,
    MarkerObservation,
    RigObservations,
    RigProblem,
    RigState,
    Tolerances,
    lay_out,
)
from measure.errors import CalibrationError
from measure.geometry import skew
from measure.limits import MAX_STEPS
from measure.model import Camera

_HUBER = Huber(3.0)
MIN_SD_PX = 0.02
START_CORNER_SD_PX = 0.1
START_MARK_SD_PX = 0.5


@dataclass(frozen=True, eq=False)
class RigFit:
    """Cameras fitted jointly, or located by equation 3."""

    state: RigState  # cameras with their covariances, and where markers and boards came out
    # of all cameras' poses and free lens parameters together, camera after camera.
    covariance: Floats
    # by camera name, which rows of `covariance` are its pose (6) and lens parameters.
    columns: dict[str, Ints]
    mark_sd_px: float  # as stated, or estimated from the residuals
    # the rest is of a joint fit alone.
    corner_sd_px: float | None = None  # as estimated from the residuals
    mark_residuals: dict[str, Floats] = field(default_factory=dict)  # by camera name (n, 2) px
    log_likelihood: float = np.nan  # restricted, up to a constant: compares tolerances and weights

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras."""
        return self.state.cameras


def fit_rig(
    start: tuple[Camera, ...],
    observations: RigObservations,
    corner_sd_px: float | None = None,
    mark_sd_px: float | None = None,
) -> RigFit:
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


def _answer(solution: LeastSquaresSolution[RigState], problem: RigProblem) -> RigFit:
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
        cameras.append(with_covariance(camera, P, free, rms))
    used = sum(len(c) for c in layout.cameras)
    return RigFit(
        replace(solution.state, cameras=tuple(cameras)),
        solution.covariance[:used, :used],
        {c.name: columns for c, columns in zip(cameras, layout.cameras, strict=True)},
        float(sds[MARKS]),
        float(sds[CORNERS]),
        residuals[MARKS],
        _log_likelihood(solution, problem),
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
) -> tuple[RigFit, Tolerances]:
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
) -> tuple[RigFit, Tolerances]:
    best: tuple[RigFit, Tolerances] | None = None
    for tolerances in candidates:
        fit = fit_rig(start, replace(observations, tolerances=tolerances), mark_sd_px=mark_sd_px)
        if best is None or fit.log_likelihood > best[0].log_likelihood:
            best = fit, tolerances
        elif fit.log_likelihood < best[0].log_likelihood - _PAST_PEAK_LOG_LIKELIHOOD:
            break
    assert best is not None
    return best


def fit_rig_by_paper(
    start: tuple[Camera, ...], observations: RigObservations, mark_sd_px: float | None = None
) -> RigFit:
    """Every camera by itself, from three markers or more, beginning at its rough pose."""
    cameras, squares, freedom = [], 0.0, 0.0
    for camera in start:
        located, residuals = _located(camera, observations)
        cameras.append(located)
        worth = located.intrinsics.focal_px / np.linalg.norm(
            observations.markers[observations.marks[camera.name].ids] - located.center, axis=1
        )
        # The variance of the marker places is in the residuals too, but is not the marks'.
        by_places = 2 * float(np.sum((worth * observations.tolerances.marker_mm) ** 2))
        share = max(1 - 6 / residuals.size, 0)
        squares += max(float(np.sum(residuals**2)) - by_places * share, 0)
        freedom += residuals.size - 6
    sd = mark_sd_px or START_MARK_SD_PX
    if mark_sd_px is None and freedom > 0:
        sd = max(float(np.sqrt(squares / freedom)), MIN_SD_PX)
    return _with_covariances(tuple(cameras), observations, sd)


def _located(start: Camera, observations: RigObservations) -> tuple[Camera, Floats]:
    """A camera by equation 3, and the residuals (n, 2) px of its marks."""
    marks = observations.marks.get(start.name)
    if marks is None:
        raise CalibrationError(
            f"camera {start.name}: the paper's method needs its markers: give marks.csv or "
            "marker_image"
        )
    if len(marks.ids) < 3:
        raise CalibrationError(
            f"camera {start.name}: the paper's equation 3 needs 3 markers, got {len(marks.ids)}"
        )
    points = observations.markers[marks.ids]
    located = _solve_equation_3(start, points, marks.pixels)
    error = marks.pixels - located.project(points)
    return replace(located, reprojection_rms_px=rms_length(error)), error


def _solve_equation_3(start: Camera, points: Floats, pixels: Floats) -> Camera:
    from scipy.optimize import least_squares

    bearings = start.intrinsics.unproject(pixels)

    def equation_3(unknowns: Floats) -> Floats:
        pose = start.world_from_camera.perturb(unknowns)
        c2m = points - pose.translation
        i2c = pose.rotate(bearings)
        return np.ravel(c2m / np.linalg.norm(c2m, axis=1, keepdims=True) - i2c)

    found = least_squares(
        equation_3, np.zeros(6), method="lm", x_scale=np.repeat([100.0, 0.1], 3), xtol=1e-12
    )
    if not found.success:
        raise CalibrationError(f"camera {start.name}: equation 3 has no optimum: {found.message}")
    return replace(start, world_from_camera=start.world_from_camera.perturb(found.x))


def _sensitivity(camera: Camera, points: Floats, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """How a camera's pose follows marks (6, 2n), lens (6, 12) and its markers (6, 3n)."""
    turn = camera.world_from_camera.rotation
    bearings = camera.intrinsics.unproject(pixels)
    _, by_bearing, pixel_by_lens = camera.intrinsics.project_with_jacobians(bearings)
    by_pixel = turn @ np.linalg.pinv(by_bearing)  # of R b, (n, 3, 2)
    c2m = points - camera.center
    length = np.linalg.norm(c2m, axis=1)[:, None, None]
    unit = c2m[:, :, None] / length
    by_marker = (np.eye(3) - unit @ np.swapaxes(unit, 1, 2)) / length
    J = np.concatenate([-by_marker, skew(bearings @ turn.T)], axis=2).reshape(-1, 6)
    gain = -np.linalg.pinv(J).reshape(6, len(points), 3)
    return (
        -np.einsum("ink,nkj->inj", gain, by_pixel).reshape(6, -1),
        np.einsum("ink,nkj,njl->il", gain, by_pixel, pixel_by_lens),
        np.einsum("ink,nkj->inj", gain, by_marker).reshape(6, -1),
    )


def _with_covariances(
    cameras: tuple[Camera, ...], observations: RigObservations, sd_px: float
) -> RigFit:
    """Marks and lenses are each camera's own; the places of the markers are common to all."""
    columns, take = dict[str, Ints](), Columns()
    own: list[Floats] = []
    common: list[Floats] = []
    for camera in cameras:
        marks = observations.marks[camera.name]
        by_marks, by_lens, by_markers = _sensitivity(
            camera, observations.markers[marks.ids], marks.pixels
        )
        C = camera.intrinsics.covariance
        C = np.zeros((12, 12)) if C is None else C
        free = free_parameters(camera)
        # Rows: pose, then the lens parameters themselves, which the poses follow.
        gain = np.concatenate([by_lens, np.eye(12)[free]])
        block = gain @ C @ gain.T
        block[:6, :6] += sd_px**2 * by_marks @ by_marks.T
        own.append(block)
        shift = np.zeros((len(block), observations.markers.size))
        of_marker = (3 * marks.ids[:, None] + np.arange(3)).reshape(-1)
        shift[:6, of_marker] = by_markers * observations.tolerances.marker_mm
        common.append(shift)
        columns[camera.name] = take(len(block))
    shifts = np.concatenate(common)
    covariance = shifts @ shifts.T
    for camera, block in zip(cameras, own, strict=True):
        covariance[np.ix_(columns[camera.name], columns[camera.name])] += block
    located = []
    for camera in cameras:
        P = covariance[np.ix_(columns[camera.name], columns[camera.name])]
        rms_px = camera.reprojection_rms_px
        located.append(with_covariance(camera, P, free_parameters(camera), rms_px))
    state = RigState(tuple(located), observations.markers, {})
    return RigFit(state, covariance, columns, sd_px)

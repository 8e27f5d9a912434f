"""Where the cameras stand: all of them at once, from board corners and markers together.

Least squares over every camera's pose and lens, the marker positions and the board poses. What is
known beforehand enters with its uncertainty: the lens with the covariance of its own fit, a marker
with the tolerance of its post, a board with the tolerance of its holder. Corners and marks are
weighted by standard deviations that the residuals themselves tell (variance components), and a
robust loss keeps a slip of the hand from bending the whole rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.least_squares import Group, Huber, Linearised, Solution, solve
from measure.calibration.lens import changed, intrinsics_vector
from measure.geometry import RigidTransform, skew
from measure.model import Camera

_HUBER_REACH = 3.0
_WEIGHT_ROUNDS = 6
_LEAST_CORNER_SD_PX = 0.01
_LEAST_MARK_SD_PX = 0.02
START_CORNER_SD_PX = 0.1
START_MARK_SD_PX = 0.5


@dataclass(frozen=True, eq=False)
class BoardSight:
    """A board of known pose, seen by one camera.

    Attributes:
        points: (n, 3) its seen corners in the board frame, mm.
        pixels: (n, 2) where they appear.
        world_from_board: its stated pose.
    """

    points: Floats
    pixels: Floats
    world_from_board: RigidTransform


@dataclass(frozen=True, eq=False)
class MarkSight:
    """Markers seen by one camera.

    Attributes:
        ids: (n,) their numbers in the field.
        pixels: (n, 2) where they appear.
        common_sd_px: standard deviation of an offset that all marks of this picture may share (the
            light draws found dots one way; a hand has no such habit).
    """

    ids: Ints
    pixels: Floats
    common_sd_px: float = 0.0


@dataclass(frozen=True)
class Tolerances:
    """How exactly the things of known place are known, as standard deviations.

    Attributes:
        marker_mm: of each coordinate of a marker; 0 is exact.
        board_mm: of each coordinate of a board's origin; 0 is exact.
        board_deg: of a board's turn about each axis; 0 is exact.
    """

    marker_mm: float = 0.1
    board_mm: float = 0.0
    board_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Sights:
    """All that the cameras see of things whose place in the world is known.

    Attributes:
        markers: (k, 3) stated positions of the markers in the world, mm.
        boards: by camera name.
        marks: by camera name.
        tolerances: of markers and boards.
    """

    markers: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    boards: Mapping[str, BoardSight] = field(default_factory=dict)
    marks: Mapping[str, MarkSight] = field(default_factory=dict)
    tolerances: Tolerances = field(default_factory=Tolerances)


@dataclass(frozen=True, eq=False)
class RigState:
    """Cameras, markers (k, 3), and by camera world_from_board and the offset (2,) of its marks."""

    cameras: tuple[Camera, ...]
    markers: Floats
    boards: dict[str, RigidTransform]
    offsets: dict[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RigFit:
    """Cameras fitted jointly.

    Attributes:
        state: cameras with their covariances, and where markers and boards came out.
        covariance: of all cameras' poses and free lens parameters together, camera after camera.
        columns: by camera name, which rows of `covariance` are its pose (6) and lens parameters.
        corner_residuals: by camera name (n, 2) px.
        mark_residuals: by camera name (n, 2) px.
        corner_sd_px: as estimated from the residuals.
        mark_sd_px: as estimated from the residuals.
        log_likelihood: restricted, up to a constant; compares tolerances and weights.
    """

    state: RigState
    covariance: Floats
    columns: dict[str, Ints]
    corner_residuals: dict[str, Floats]
    mark_residuals: dict[str, Floats]
    corner_sd_px: float
    mark_sd_px: float
    log_likelihood: float

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The calibrated cameras."""
        return self.state.cameras


@dataclass(frozen=True, eq=False)
class _Layout:
    """Which shared parameter is which."""

    lens_free: tuple[Ints, ...]
    cameras: tuple[Ints, ...]
    markers: Ints | None
    boards: dict[str, Ints]
    offsets: dict[str, Ints]
    size: int


def fit_rig(
    start: tuple[Camera, ...],
    sights: Sights,
    corner_sd_px: float | None = None,
    mark_sd_px: float | None = None,
) -> RigFit:
    """Fit all cameras jointly.

    Args:
        start: cameras with rough poses; a lens with a covariance is refined within it, one without
            stays as it is.
        sights: boards and marks.
        corner_sd_px: known standard deviation of a corner coordinate; estimated if omitted.
        mark_sd_px: known standard deviation of a mark coordinate; estimated if omitted.

    Raises:
        CalibrationError: the sights leave a camera's pose undetermined.
    """
    layout = _layout(start, sights)
    state = RigState(
        start,
        sights.markers,
        {name: board.world_from_board for name, board in sights.boards.items()},
        {name: np.zeros(2) for name in layout.offsets},
    )
    sds = np.array([corner_sd_px or START_CORNER_SD_PX, mark_sd_px or START_MARK_SD_PX])
    fixed = np.array([corner_sd_px is not None, mark_sd_px is not None])
    for _ in range(_WEIGHT_ROUNDS):
        solution = _solve(start, state, sights, layout, sds)
        state = solution.state
        estimated = _standard_deviations(solution, sights, sds)
        if np.all(fixed | (np.abs(estimated / sds - 1) < 1e-3)):
            break
        sds = np.where(fixed, sds, estimated)
    return _answer(solution, sights, layout, sds)


def _layout(cameras: tuple[Camera, ...], sights: Sights) -> _Layout:
    free, columns, size = [], [], 0
    for camera in cameras:
        P = camera.intrinsics.covariance
        lens = np.flatnonzero(np.diag(P) > 0) if P is not None else np.zeros(0, dtype=np.int64)
        free.append(lens)
        columns.append(np.arange(size, size + 6 + len(lens)))
        size += 6 + len(lens)
    markers = None
    if sights.tolerances.marker_mm > 0 and len(sights.markers):
        markers = np.arange(size, size + 3 * len(sights.markers))
        size += len(markers)
    boards = {}
    if sights.tolerances.board_mm > 0 or sights.tolerances.board_deg > 0:
        for name in sights.boards:
            boards[name] = np.arange(size, size + 6)
            size += 6
    offsets = {}
    for name, marks in sights.marks.items():
        if marks.common_sd_px > 0:
            offsets[name] = np.arange(size, size + 2)
            size += 2
    return _Layout(tuple(free), tuple(columns), markers, boards, offsets, size)


def _solve(
    start: tuple[Camera, ...], state: RigState, sights: Sights, layout: _Layout, sds: Floats
) -> Solution[RigState]:
    def linearise(here: RigState) -> Linearised:
        groups = []
        for camera, columns, free in zip(
            here.cameras, layout.cameras, layout.lens_free, strict=True
        ):
            groups += _camera_groups(camera, columns, free, here, sights, layout, sds)
        residuals, rows = _priors(start, here, sights, layout)
        return Linearised(tuple(groups), layout.size, 0, residuals, rows)

    def step(here: RigState, shared: Floats, _: Floats) -> RigState:
        cameras = tuple(
            changed(c, shared[cols], free)
            for c, cols, free in zip(here.cameras, layout.cameras, layout.lens_free, strict=True)
        )
        markers = here.markers
        if layout.markers is not None:
            markers = markers + shared[layout.markers].reshape(-1, 3)
        boards = {
            name: pose.perturb(shared[layout.boards[name]]) if name in layout.boards else pose
            for name, pose in here.boards.items()
        }
        offsets = {
            name: here.offsets[name] + shared[columns] for name, columns in layout.offsets.items()
        }
        return RigState(cameras, markers, boards, offsets)

    return solve(linearise, step, state, Huber(_HUBER_REACH))


def _camera_groups(
    camera: Camera,
    columns: Ints,
    free: Ints,
    here: RigState,
    sights: Sights,
    layout: _Layout,
    sds: Floats,
) -> list[Group]:
    """Corner and mark observations of one camera (always two groups, maybe empty)."""
    board, marks = sights.boards.get(camera.name), sights.marks.get(camera.name)
    groups = []
    if board is not None:
        pose = here.boards[camera.name]
        points = pose.apply(board.points)
        own = layout.boards.get(camera.name)
        by_world = None
        if own is not None:
            by_world = np.concatenate(
                [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -skew(points - pose.translation)],
                axis=2,
            )
        groups.append(_group(camera, columns, free, points, board.pixels, own, by_world, sds[0]))
    if marks is not None and len(marks.ids):
        points, by_world = here.markers[marks.ids], None
        if layout.markers is not None:
            by_world = np.zeros((len(points), 3, len(layout.markers)))
            for row, number in enumerate(marks.ids):
                by_world[row, :, 3 * number : 3 * number + 3] = np.eye(3)
        offset = here.offsets.get(camera.name, np.zeros(2))
        group = _group(
            camera, columns, free, points, marks.pixels - offset, layout.markers, by_world, sds[1]
        )
        if camera.name in layout.offsets:
            shift = np.broadcast_to(np.eye(2) / sds[1], (len(points), 2, 2))
            group = replace(
                group,
                columns=np.concatenate([group.columns, layout.offsets[camera.name]]),
                by_shared=np.concatenate([group.by_shared, shift], axis=2),
            )
        groups.append(group)
    return groups


def _group(
    camera: Camera,
    columns: Ints,
    free: Ints,
    points: Floats,
    pixels: Floats,
    extra: Ints | None,
    by_world_of_extra: Floats | None,
    sd_px: float,
) -> Group:
    predicted, by_world, by_pose, by_lens = camera.project_with_jacobians(points)
    parts = [by_pose, by_lens[:, :, free]]
    if extra is not None and by_world_of_extra is not None:
        parts.append(by_world @ by_world_of_extra)
        columns = np.concatenate([columns, extra])
    n = len(points)
    return Group(
        (pixels - predicted) / sd_px,
        columns,
        np.concatenate(parts, axis=2) / sd_px,
        np.zeros(0, dtype=np.int64),
        np.zeros((n, 2, 0)),
    )


def _priors(
    start: tuple[Camera, ...], here: RigState, sights: Sights, layout: _Layout
) -> tuple[Floats, Floats]:
    residuals: list[Floats] = []
    rows: list[Floats] = []

    def add(residual: Floats, root: Floats, columns: Ints) -> None:
        row = np.zeros((len(root), layout.size))
        row[:, columns] = root
        residuals.append(root @ residual)
        rows.append(row)

    for first, now, columns, free in zip(
        start, here.cameras, layout.cameras, layout.lens_free, strict=True
    ):
        if len(free):
            root = _root_information(first.intrinsics.covariance, free)
            change = _lens_difference(first, now, free)
            add(change, root, columns[6:])
    if layout.markers is not None:
        root = np.eye(len(layout.markers)) / sights.tolerances.marker_mm
        add((sights.markers - here.markers).reshape(-1), root, layout.markers)
    spread = np.repeat([sights.tolerances.board_mm, np.deg2rad(sights.tolerances.board_deg)], 3)
    for name, columns in layout.offsets.items():
        add(-here.offsets[name], np.eye(2) / sights.marks[name].common_sd_px, columns)
    for name, columns in layout.boards.items():
        root = np.diag(1 / np.maximum(spread, 1e-9))
        stated = sights.boards[name].world_from_board
        add(-here.boards[name].difference(stated), root, columns)
    if not rows:
        return np.zeros(0), np.zeros((0, layout.size))
    return np.concatenate(residuals), np.concatenate(rows)


def _lens_difference(first: Camera, now: Camera, free: Ints) -> Floats:
    """Free lens parameters of `first` less those of `now`."""
    return (intrinsics_vector(first.intrinsics) - intrinsics_vector(now.intrinsics))[free]


def _root_information(covariance: Floats | None, free: Ints) -> Floats:
    """Upper triangular R with R^T R the inverse of the covariance of the free parameters."""
    assert covariance is not None
    P = covariance[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(P))
    return np.linalg.inv(np.linalg.cholesky(P * scale[:, None] * scale)) * scale


def _standard_deviations(solution: Solution[RigState], sights: Sights, sds: Floats) -> Floats:
    """Standard deviations of corners and marks from their residuals and redundancies.

    Variance components in Förstner's form: a class's squared residuals over its share of the
    degrees of freedom, the trace of (1 - leverage).
    """
    squares, redundancy = np.zeros(2), np.zeros(2)
    for group, (_, kind) in zip(
        solution.linearised.groups, _labels(solution.state, sights), strict=True
    ):
        lengths = np.linalg.norm(group.residuals, axis=1)
        weights = Huber(_HUBER_REACH).weights(lengths)
        P = solution.covariance[np.ix_(group.columns, group.columns)]
        leverage = np.einsum("nki,ij,nkj->n", group.by_shared, P, group.by_shared) * weights
        squares[kind] += float(np.sum(weights * lengths**2))
        redundancy[kind] += float(np.sum(2 - leverage))
    factor = np.where(redundancy > 1, squares / np.maximum(redundancy, 1), 1.0)
    return np.maximum(sds * np.sqrt(factor), [_LEAST_CORNER_SD_PX, _LEAST_MARK_SD_PX])


def _labels(state: RigState, sights: Sights) -> list[tuple[str, int]]:
    """Camera and kind (0 corners, 1 marks) of the groups, in their order."""
    labels = []
    for camera in state.cameras:
        if camera.name in sights.boards:
            labels.append((camera.name, 0))
        if camera.name in sights.marks and len(sights.marks[camera.name].ids):
            labels.append((camera.name, 1))
    return labels


def _answer(solution: Solution[RigState], sights: Sights, layout: _Layout, sds: Floats) -> RigFit:
    used = sum(len(c) for c in layout.cameras)
    cameras = []
    for camera, columns, free in zip(
        solution.state.cameras, layout.cameras, layout.lens_free, strict=True
    ):
        P = solution.covariance[np.ix_(columns, columns)]
        lens = np.zeros((12, 12))
        lens[np.ix_(free, free)] = P[6:, 6:]
        cameras.append(
            replace(
                camera,
                intrinsics=replace(camera.intrinsics, covariance=lens),
                pose_covariance=P[:6, :6],
            )
        )
    corners: dict[str, Floats] = {}
    marks: dict[str, Floats] = {}
    labels = _labels(solution.state, sights)
    for (name, kind), group in zip(labels, solution.linearised.groups, strict=True):
        (marks if kind else corners)[name] = group.residuals * sds[kind]
    finished = tuple(
        replace(c, reprojection_rms_px=_rms([corners.get(c.name), marks.get(c.name)]))
        for c in cameras
    )
    return RigFit(
        replace(solution.state, cameras=finished),
        solution.covariance[:used, :used],
        {c.name: columns for c, columns in zip(finished, layout.cameras, strict=True)},
        corners,
        marks,
        float(sds[0]),
        float(sds[1]),
        _log_likelihood(solution, sights, sds),
    )


def _log_likelihood(solution: Solution[RigState], sights: Sights, sds: Floats) -> float:
    """Of the residuals, with the unknowns integrated out (up to a constant)."""
    groups = solution.linearised.groups
    spread = sum(
        group.residuals.size * np.log(sds[kind])
        for group, (_, kind) in zip(groups, _labels(solution.state, sights), strict=True)
    )
    tolerances = sights.tolerances
    if tolerances.board_mm > 0 and tolerances.board_deg > 0:
        one = np.log(tolerances.board_mm) + np.log(np.deg2rad(tolerances.board_deg))
        spread += 3 * len(sights.boards) * one
    _, volume = np.linalg.slogdet(solution.covariance)
    return float(-0.5 * solution.cost - spread + 0.5 * volume)


def _rms(parts: list[Floats | None]) -> float:
    rows = np.concatenate([p for p in parts if p is not None])
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))

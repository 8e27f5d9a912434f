"""Cameras relative to each other, from one board that several of them see at the same instants."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, Ints, rms_length
from measure.calibration.boards import Corners
from measure.calibration.intrinsics import LensCalibration
from measure.calibration.least_squares import Group, Huber, LeastSquaresSolution, Linearised, solve
from measure.calibration.lens import changed, stack, with_covariance
from measure.calibration.single_camera import board_pose
from measure.errors import CalibrationError
from measure.geometry import RigidTransform, skew
from measure.model import Camera

_HUBER_REACH = 4.0
_MIN_COMMON = 3
_ONE_INSTANT_PX = 3.0
"""Cameras that miss common views by more than this did not take them together."""


@dataclass(frozen=True, eq=False)
class _CommonViewsState:
    cameras: tuple[Camera, ...]
    world_from_board: RigidTransform  # a batch, one an instant


def fit_common_views(
    points: Floats, lenses: Mapping[str, LensCalibration]
) -> tuple[tuple[Camera, ...], Floats]:
    """Fit all cameras, lenses included, with the first camera as the world.

    Pictures of one instant carry the same number in their names, or are frames of that number.

    Args:
        points: (k, 3) the board's corners, mm.
        lenses: each camera's lens and views.

    Returns:
        The cameras, and the board's corners in the world at all instants (n, 3) mm.

    Raises:
        CalibrationError: a camera shares fewer than three views with those already placed, or its
            pictures contradict the others'.
    """
    views = {
        name: {_instant(v.source): v for v in lens.views.views} for name, lens in lenses.items()
    }
    cameras, boards = _start(points, lenses, views)
    instants = sorted(boards)
    sds = {name: lens.fit.sd_px for name, lens in lenses.items()}
    free = {name: np.array(lens.model.free, dtype=np.int64) for name, lens in lenses.items()}
    order = {instant: number for number, instant in enumerate(instants)}
    problem = _CommonViewsProblem(points, views, sds, free, _columns(cameras, free), order)
    start = _CommonViewsState(cameras, stack([boards[i] for i in instants]))
    solution = solve(problem.linearise, problem.step, start, Huber(_HUBER_REACH))
    poses = solution.state.world_from_board
    corners = np.einsum("fij,nj->fni", poses.rotation, points) + poses.translation[:, None]
    found = _answer(solution, sds, free)
    _check_instants(found, lenses)
    return found, corners.reshape(-1, 3)


def _check_instants(cameras: tuple[Camera, ...], lenses: Mapping[str, LensCalibration]) -> None:
    worst = max(cameras, key=lambda camera: camera.reprojection_rms_px or 0.0)
    missed_px, alone_px = worst.reprojection_rms_px or 0.0, lenses[worst.name].fit.rms_px
    if missed_px > alone_px + _ONE_INSTANT_PX:
        raise CalibrationError(
            f"camera {worst.name}: misses the common views by {missed_px:.1f} px, by itself by "
            f"{alone_px:.1f} px: do pictures (video frames) of one number show one instant?"
        )


def _instant(source: str) -> int:
    """The last number in a picture's name, or that of a video's frame."""
    numbers = re.findall(r"\d+", re.sub(r"\.\w+$", "", source))
    if not numbers:
        raise CalibrationError(f"{source}: common views need a number in the name of each picture")
    return int(numbers[-1])


def _start(
    points: Floats,
    lenses: Mapping[str, LensCalibration],
    views: Mapping[str, Mapping[int, Corners]],
) -> tuple[tuple[Camera, ...], dict[int, RigidTransform]]:
    """Camera after camera, by the board poses it shares with those placed before."""
    placed: dict[str, Camera] = {}
    boards: dict[int, RigidTransform] = {}
    waiting = list(lenses)
    while waiting:
        name = max(waiting, key=lambda n: len(views[n].keys() & boards.keys()))
        if not placed:
            name = waiting[0]
        waiting.remove(name)
        lens = lenses[name].intrinsics
        from_board = {i: board_pose(lens, points[v.ids], v.pixels) for i, v in views[name].items()}
        common = sorted(from_board.keys() & boards.keys())
        if placed and len(common) < _MIN_COMMON:
            raise CalibrationError(
                f"camera {name}: shares {len(common)} board views with the other cameras, at least "
                f"{_MIN_COMMON} are needed"
            )
        pose = RigidTransform.identity()
        if placed:
            guesses = stack([boards[i] @ from_board[i].inverse() for i in common])
            distance = np.linalg.norm(
                guesses.translation - np.median(guesses.translation, axis=0), axis=1
            )
            pose = guesses[int(np.argmin(distance))]
        placed[name] = Camera(name, lens, pose)
        boards |= {i: pose @ p for i, p in from_board.items() if i not in boards}
    return tuple(placed[name] for name in lenses), boards


@dataclass(frozen=True, eq=False)
class _CommonViewsProblem:
    """Boards seen by several cameras at the same instants; the first camera is the world.

    Attributes:
        points: (n, 3) of the board.
        views: by camera name and instant.
        sds: of a corner, by camera name, px.
        free: by camera name, which lens parameters are free.
        columns: by camera name, its unknowns' columns.
        order: number of each instant's board.
    """

    points: Floats
    views: Mapping[str, Mapping[int, Corners]]
    sds: Mapping[str, float]
    free: Mapping[str, Ints]
    columns: Mapping[str, Ints]
    order: Mapping[int, int]

    def linearise(self, state: _CommonViewsState) -> Linearised:
        groups = tuple(self._group(n, state) for n in range(len(state.cameras)))
        size = sum(len(c) for c in self.columns.values())
        return Linearised(groups, size, len(self.order), np.zeros(0), np.zeros((0, size)))

    def step(self, state: _CommonViewsState, shared: Floats, blocks: Floats) -> _CommonViewsState:
        cameras = []
        for number, camera in enumerate(state.cameras):
            part = shared[self.columns[camera.name]]
            part = np.concatenate([np.zeros(6), part]) if number == 0 else part
            cameras.append(changed(camera, part, self.free[camera.name]))
        return _CommonViewsState(tuple(cameras), state.world_from_board.perturb(blocks))

    def _group(self, number: int, state: _CommonViewsState) -> Group:
        camera, poses = state.cameras[number], state.world_from_board
        mine = sorted(self.views[camera.name].items())
        block = np.concatenate([np.full(len(v.ids), self.order[i]) for i, v in mine])
        ids = np.concatenate([v.ids for _, v in mine])
        pixels = np.concatenate([v.pixels for _, v in mine])
        turned = np.einsum("nij,nj->ni", poses.rotation[block], self.points[ids])
        placed = turned + poses.translation[block]
        predicted, by_world, by_pose, by_lens = camera.project_with_jacobians(placed)
        shared = [by_lens[:, :, self.free[camera.name]]]
        if number > 0:
            shared = [by_pose, *shared]
        own = np.concatenate([by_world, -by_world @ skew(turned)], axis=2)
        sd = self.sds[camera.name]
        return Group(
            (pixels - predicted) / sd,
            self.columns[camera.name],
            np.concatenate(shared, axis=2) / sd,
            block,
            own / sd,
        )


def _columns(cameras: tuple[Camera, ...], free: Mapping[str, Ints]) -> dict[str, Ints]:
    columns, size = {}, 0
    for number, camera in enumerate(cameras):
        length = len(free[camera.name]) + (0 if number == 0 else 6)
        columns[camera.name] = np.arange(size, size + length)
        size += length
    return columns


def _answer(
    solution: LeastSquaresSolution[_CommonViewsState],
    sds: Mapping[str, float],
    free: Mapping[str, Ints],
) -> tuple[Camera, ...]:
    columns = _columns(solution.state.cameras, free)
    factor = max(solution.variance_factor, 1.0)
    out = []
    for number, (camera, group) in enumerate(
        zip(solution.state.cameras, solution.linearised.groups, strict=True)
    ):
        own, lens = columns[camera.name], free[camera.name]
        P = np.zeros((6 + len(lens), 6 + len(lens)))
        known = slice(6, None) if number == 0 else slice(None)
        P[known, known] = solution.covariance[np.ix_(own, own)] * factor
        rms = rms_length(group.residuals * sds[camera.name])
        out.append(with_covariance(camera, P, lens, rms))
    return tuple(out)

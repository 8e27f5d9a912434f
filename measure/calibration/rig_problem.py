"""The least-squares problem of a rig: what its cameras see of known things, and the unknowns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.board_views import changed, lens_change
from measure.calibration.least_squares import (
    Columns,
    Group,
    Linearised,
    prior_rows,
    root_information,
)
from measure.geometry import RigidTransform, skew
from measure.model import BoardObservation, Camera, MarkerObservation, RigObservations

CORNERS, MARKS = 0, 1  # The two kinds of observation, each with its own standard deviation


@dataclass(frozen=True, eq=False)
class RigState:
    """Cameras, markers (k, 3), and by camera world_from_board and the offset (2,) of its marks."""

    cameras: tuple[Camera, ...]
    markers: Floats
    boards: dict[str, RigidTransform]
    offsets: dict[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RigLayout:
    """Which shared parameter is which."""

    lens_free: tuple[Ints, ...]  # for each camera, which lens parameters are unknown
    cameras: tuple[Ints, ...]  # for each camera, the columns of its pose and free lens parameters
    markers: Ints | None  # columns of all markers, or None where they are exact
    boards: dict[str, Ints]  # columns of the boards that are not exact, by camera name
    offsets: dict[str, Ints]  # columns of the offsets of marks, by camera name
    size: int


def lay_out(cameras: tuple[Camera, ...], observations: RigObservations) -> RigLayout:
    """Number the unknowns: cameras first, then markers, boards and offsets as far as unknown."""
    take = Columns()
    tolerances = observations.tolerances
    free = tuple(camera.intrinsics.free for camera in cameras)
    of_cameras = tuple(take(6 + len(lens)) for lens in free)
    markers = None
    if tolerances.marker_mm > 0 and len(observations.markers):
        markers = take(3 * len(observations.markers))
    boards, offsets = {}, {}
    if tolerances.board_mm > 0 or tolerances.board_deg > 0:
        boards = {name: take(6) for name in observations.boards}
    if tolerances.common_px > 0:
        offsets = {n: take(2) for n, marks in observations.marks.items() if marks.searched}
    return RigLayout(free, of_cameras, markers, boards, offsets, take.size)


@dataclass(frozen=True, eq=False)
class RigProblem:
    """All cameras at once."""

    start: tuple[Camera, ...]  # cameras as they are known beforehand
    observations: RigObservations
    layout: RigLayout
    sds: Floats  # (2,) standard deviations in px of corners and marks

    def labels(self) -> list[tuple[str, int]]:
        """Camera name and kind of the observation groups, in their order."""
        labels = []
        for camera in self.start:
            if camera.name in self.observations.boards:
                labels.append((camera.name, CORNERS))
            marks = self.observations.marks.get(camera.name)
            if marks is not None and len(marks.ids):
                labels.append((camera.name, MARKS))
        return labels

    def linearise(self, here: RigState) -> Linearised:
        """Whitened residuals and derivatives at a state."""
        order = {camera.name: number for number, camera in enumerate(self.start)}
        groups = []
        for name, kind in self.labels():
            if kind == CORNERS:
                groups.append(self._corners(here, order[name], self.observations.boards[name]))
            else:
                groups.append(self._marks(here, order[name], self.observations.marks[name]))
        parts = list(self._priors(here))
        residuals = [residual for residual, _ in parts]
        rows = [row for _, row in parts]
        nothing = np.zeros((0, self.layout.size))
        return Linearised(
            tuple(groups),
            self.layout.size,
            0,
            np.concatenate([np.zeros(0), *residuals]),
            np.concatenate([nothing, *rows]),
        )

    def step(self, here: RigState, shared: Floats, _: Floats) -> RigState:
        """The state after an increment of all unknowns."""
        layout = self.layout
        cameras = tuple(
            changed(camera, shared[columns], free)
            for camera, columns, free in zip(
                here.cameras, layout.cameras, layout.lens_free, strict=True
            )
        )
        markers = here.markers
        if layout.markers is not None:
            markers = markers + shared[layout.markers].reshape(-1, 3)
        boards = {
            name: pose.perturb(shared[layout.boards[name]]) if name in layout.boards else pose
            for name, pose in here.boards.items()
        }
        offsets = {name: here.offsets[name] + shared[c] for name, c in layout.offsets.items()}
        return RigState(cameras, markers, boards, offsets)

    def _corners(self, here: RigState, number: int, board: BoardObservation) -> Group:
        name = here.cameras[number].name
        pose = here.boards[name]
        points = pose.apply(board.points)
        own = self.layout.boards.get(name)
        extra: list[tuple[Ints, Floats]] = []
        seen = here.cameras[number].project_with_jacobians(points)
        if own is not None:
            shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
            turn = -skew(points - pose.translation)
            extra.append((own, seen[1] @ np.concatenate([shift, turn], axis=2)))
        return self._group(seen, board.pixels, number, extra, CORNERS)

    def _marks(self, here: RigState, number: int, marks: MarkerObservation) -> Group:
        name = here.cameras[number].name
        seen = here.cameras[number].project_with_jacobians(here.markers[marks.ids])
        extra: list[tuple[Ints, Floats]] = []
        if self.layout.markers is not None:
            by_markers = np.zeros((len(marks.ids), 2, len(self.layout.markers)))
            for row, marker in enumerate(marks.ids):
                by_markers[row, :, 3 * marker : 3 * marker + 3] = seen[1][row]
            extra.append((self.layout.markers, by_markers))
        pixels = marks.pixels
        if name in self.layout.offsets:
            pixels = pixels - here.offsets[name]
            shift = np.broadcast_to(np.eye(2), (len(marks.ids), 2, 2))
            extra.append((self.layout.offsets[name], shift))
        return self._group(seen, pixels, number, extra, MARKS)

    def _group(
        self,
        seen: tuple[Floats, Floats, Floats, Floats],
        pixels: Floats,
        number: int,
        extra: list[tuple[Ints, Floats]],
        kind: int,
    ) -> Group:
        """Of pixels predicted with their derivatives by point, pose and lens."""
        predicted, _, by_pose, by_lens = seen
        free, sd = self.layout.lens_free[number], self.sds[kind]
        columns = [self.layout.cameras[number], *(c for c, _ in extra)]
        parts = [by_pose, by_lens[:, :, free], *(part for _, part in extra)]
        return Group(
            (pixels - predicted) / sd,
            np.concatenate(columns),
            np.concatenate(parts, axis=2) / sd,
            np.zeros(0, dtype=np.int64),
            np.zeros((len(pixels), 2, 0)),
        )

    def _priors(self, here: RigState) -> Iterator[tuple[Floats, Floats]]:
        """Whitened residuals and derivative rows of all that is known beforehand."""
        layout, observations = self.layout, self.observations
        for first, now, columns, free in zip(
            self.start, here.cameras, layout.cameras, layout.lens_free, strict=True
        ):
            if len(free):
                assert first.intrinsics.covariance is not None
                root = root_information(first.intrinsics.covariance[np.ix_(free, free)])
                yield prior_rows(lens_change(now, first)[free], root, columns[6:], layout.size)
        if layout.markers is not None:
            root = np.eye(len(layout.markers)) / observations.tolerances.marker_mm
            off = (observations.markers - here.markers).reshape(-1)
            yield prior_rows(off, root, layout.markers, layout.size)
        for name, columns in layout.offsets.items():
            root = np.eye(2) / observations.tolerances.common_px
            yield prior_rows(-here.offsets[name], root, columns, layout.size)
        board_sd = [observations.tolerances.board_mm, np.deg2rad(observations.tolerances.board_deg)]
        root = np.diag(1 / np.maximum(np.repeat(board_sd, 3), 1e-9))
        for name, columns in layout.boards.items():
            stated = observations.boards[name].world_from_board
            off = -here.boards[name].difference(stated)
            yield prior_rows(off, root, columns, layout.size)

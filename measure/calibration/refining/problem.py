"""The least-squares problem of refining: which unknown is where, residuals and derivatives.

Unknown are the cameras (pose, free lens parameters; on demand their clocks), the body's ball
centres, one pose of the body a frame set, and a constant shift of every ball in every camera: light
from one side displaces the edges of a ball always the same way. Without these shifts the covariance
would shrink with the number of pictures although that error does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration import least_squares
from measure.calibration.board_views import changed
from measure.calibration.refining.priors import CameraPrior, NoiseModel
from measure.calibration.refining.recording import BallMotion, Recording
from measure.estimation.losses import HUBER_SIGMAS, Huber
from measure.geometry import RigidTransform, skew
from measure.model import Body, Camera

_ONE_ROUND = least_squares.StoppingRule(steps=2, tolerance=1e-7, must_settle=False, damping=1e-12)
"""Damping must be far below the prior of the world frame, which a long recording outweighs."""
_CLOCK_SD_S = 0.02  # Clocks that are off at all are off by something like this


@dataclass(frozen=True, eq=False)
class RefinedState:
    """The unknowns."""

    cameras: tuple[Camera, ...]
    centers: Floats  # (k, 3) ball centres in the body, mm
    shifts_px: Floats  # (c, k, 2) constant shift of each ball in each camera
    clocks_s: Floats  # (c,) what each camera's time stamps lack
    world_from_body: RigidTransform  # batch of (f,)


@dataclass(frozen=True, eq=False)
class RefineLayout:
    """Which shared unknown stands in which column."""

    free: tuple[Ints, ...]  # by camera, which lens parameters are free
    cameras: tuple[Ints, ...]  # by camera, its pose's and then its free lens parameters' columns
    centers: Ints  # of the ball centres; empty if the body is exact
    shifts: Ints  # (c, 2 k) of the constant shifts, by camera
    clocks: Ints  # of the clocks of all cameras but the first; empty if the stamps are exact
    size: int

    @classmethod
    def of(
        cls,
        cameras: tuple[Camera, ...],
        balls: int,
        body_is_exact: bool,
        clocks_are_exact: bool = True,
    ) -> RefineLayout:
        """Lay out: cameras, then centres, then shifts, then clocks."""
        take = least_squares.Columns()
        free = tuple(camera.intrinsics.free for camera in cameras)
        own = tuple(take(6 + len(lens)) for lens in free)
        centers = take(0 if body_is_exact else 3 * balls)
        shifts = take(2 * balls * len(cameras)).reshape(len(cameras), -1)
        clocks = take(0 if clocks_are_exact else len(cameras) - 1)
        return cls(free, own, centers, shifts, clocks, take.size)


class RefineProblem:
    """Residuals and derivatives at a state, under a given scatter."""

    def __init__(
        self, layout: RefineLayout, body: Body, body_tolerance_mm: float, recording: Recording
    ) -> None:
        self.layout, self.body, self.recording = layout, body, recording
        self._body_tolerance_mm = body_tolerance_mm

    def start(self, cameras: tuple[Camera, ...]) -> RefinedState:
        """The cameras as calibrated, the body as nominal, nothing shifted."""
        shifts = np.zeros((len(cameras), len(self.body.balls), 2))
        clocks, poses = np.zeros(len(cameras)), self.recording.world_from_body
        return RefinedState(cameras, self.body.centers, shifts, clocks, poses)

    def solve(
        self, state: RefinedState, prior: CameraPrior | None, noise: NoiseModel
    ) -> least_squares.LeastSquaresSolution[RefinedState]:
        """A few steps from a state, the motion held; without a prior the cameras stay put."""
        motion = BallMotion(self.recording.times_s, state.world_from_body, state.centers)
        roots = self._roots(noise)
        # The correlation widens the covariances, but must not widen the reach of the loss.
        reach = HUBER_SIGMAS / np.sqrt(noise.correlation)
        return least_squares.solve(
            lambda s: self._linearise(s, motion, roots, prior, noise),
            self._step,
            state,
            Huber(float(reach)),
            _ONE_ROUND,
        )

    def residuals_px(self, state: RefinedState) -> dict[str, Floats]:
        """By camera, what is left (n, 2) of its observations."""
        motion = BallMotion(self.recording.times_s, state.world_from_body, state.centers)
        out = {}
        for number, camera in enumerate(state.cameras):
            track = self.recording.tracks[camera.name]
            points, _, _ = self._points(number, state, motion)
            shift = state.shifts_px[number, track.ball]
            out[camera.name] = track.pixels - camera.project(points) - shift
        return out

    def _roots(self, noise: NoiseModel) -> dict[str, Floats]:
        """By camera, inverse Cholesky factors (n, 2, 2) of the observations' covariances."""
        extra = noise.view_px**2 * np.eye(2)
        return {
            name: np.linalg.inv(np.linalg.cholesky(noise.correlation * (track.covariance + extra)))
            for name, track in self.recording.tracks.items()
        }

    def _points(
        self, number: int, state: RefinedState, motion: BallMotion
    ) -> tuple[Floats, Floats, Floats]:
        """World places (n, 3) of a camera's balls, their arms from the body, velocities."""
        track = self.recording.tracks[state.cameras[number].name]
        poses = state.world_from_body
        lead = track.lead_s + state.clocks_s[number]
        moved, velocity = motion.at(track.frame, track.ball, lead)
        turn = poses.rotation[track.frame]
        arms = np.einsum("nij,nj->ni", turn, state.centers[track.ball] + moved)
        points = arms + poses.translation[track.frame]
        return points, arms, np.einsum("nij,nj->ni", turn, velocity)

    def _step(self, state: RefinedState, shared: Floats, blocks: Floats) -> RefinedState:
        layout = self.layout
        shared = shared if len(shared) else np.zeros(layout.size)
        cameras = tuple(
            changed(camera, shared[columns], free)
            for camera, columns, free in zip(
                state.cameras, layout.cameras, layout.free, strict=True
            )
        )
        centers = state.centers
        if len(layout.centers):
            centers = centers + shared[layout.centers].reshape(-1, 3)
        shifts = state.shifts_px + shared[layout.shifts].reshape(state.shifts_px.shape)
        clocks = state.clocks_s.copy()
        if len(layout.clocks):
            clocks[1:] += shared[layout.clocks]
        poses = state.world_from_body.perturb(blocks)
        return RefinedState(cameras, centers, shifts, clocks, poses)

    def _linearise(
        self,
        state: RefinedState,
        motion: BallMotion,
        roots: dict[str, Floats],
        prior: CameraPrior | None,
        noise: NoiseModel,
    ) -> least_squares.Linearised:
        groups = tuple(
            self._group(number, state, motion, roots) for number in range(len(state.cameras))
        )
        blocks = len(self.recording.times_s)
        if prior is None:
            nothing = np.zeros(0, dtype=np.int64)
            held = tuple(
                replace(g, columns=nothing, by_shared=g.by_shared[:, :, :0]) for g in groups
            )
            return least_squares.Linearised(held, 0, blocks, np.zeros(0), np.zeros((0, 0)))
        residuals, rows = self._priors(state, prior, noise)
        return least_squares.Linearised(groups, self.layout.size, blocks, residuals, rows)

    def _group(
        self, number: int, state: RefinedState, motion: BallMotion, roots: dict[str, Floats]
    ) -> least_squares.Group:
        layout, camera = self.layout, state.cameras[number]
        track, root = self.recording.tracks[camera.name], roots[camera.name]
        points, arms, velocity = self._points(number, state, motion)
        predicted, by_world, by_camera, by_lens = camera.project_with_jacobians(points)
        count, balls = len(points), len(state.centers)
        rows = np.arange(count)
        by_center = np.zeros((count, 3, balls if len(layout.centers) else 0, 3))
        if len(layout.centers):
            by_center[rows, :, track.ball] = state.world_from_body.rotation[track.frame]
        by_shift = np.zeros((count, 2, balls, 2))
        by_shift[rows, :, track.ball] = np.eye(2)
        shared = [
            by_camera,
            by_lens[:, :, layout.free[number]],
            by_world @ by_center.reshape(count, 3, -1),
            by_shift.reshape(count, 2, -1),
        ]
        clock = layout.clocks[number - 1 : number] if number else layout.clocks[:0]
        shared += [by_world @ velocity[:, :, None]] * len(clock)
        by_pose = np.concatenate([by_world, -by_world @ skew(arms)], axis=2)
        left = track.pixels - predicted - state.shifts_px[number, track.ball]
        return least_squares.Group(
            np.einsum("nij,nj->ni", root, left),
            np.concatenate([layout.cameras[number], layout.centers, layout.shifts[number], clock]),
            root @ np.concatenate(shared, axis=2),
            track.frame,
            root @ by_pose,
        )

    def _priors(
        self, state: RefinedState, prior: CameraPrior, noise: NoiseModel
    ) -> tuple[Floats, Floats]:
        layout = self.layout
        root = prior.root(noise)
        change, own = prior.change(state.cameras, layout.free), np.concatenate(layout.cameras)
        priors = [least_squares.prior_rows(-change, root, own, layout.size)]
        parts: list[tuple[Floats, float, Ints]] = []
        if len(layout.centers):
            off = (self.body.centers - state.centers).reshape(-1)
            parts.append((off, self._body_tolerance_mm, layout.centers))
        parts.append((-state.shifts_px.reshape(-1), noise.constant_px, layout.shifts.reshape(-1)))
        if len(layout.clocks):
            parts.append((-state.clocks_s[1:], _CLOCK_SD_S, layout.clocks))
        priors += [
            least_squares.prior_rows(off, np.eye(len(off)) / sd, at, layout.size)
            for off, sd, at in parts
        ]
        residuals, rows = zip(*priors, strict=True)
        return np.concatenate(residuals), np.concatenate(rows)

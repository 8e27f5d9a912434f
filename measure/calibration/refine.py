"""Bundle adjustment from the moving body: the balls are the calibration wand.

Unknown are the cameras (pose, lens, clock), one pose of the body a frame set, and the body's own
ball centres with the nominal ones as prior. Scale comes from the ball distances; the world frame
from the first calibration, whose covariances enter as priors. The poses are eliminated frame by
frame (see `least_squares`), so the time grows with the number of frames only linearly.

A picture taken dt after its frame set's instant saw the balls elsewhere: the way there is read off
polynomials through the balls' places, and the clock offsets move dt.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats, Ints
from measure.calibration.least_squares import Group, Huber, Linearised, Solution, solve
from measure.calibration.lens import changed, intrinsics_vector
from measure.calibration.motion import MIN_FRAMES, Motion, Recording, ball_places
from measure.errors import CalibrationError
from measure.geometry import RigidTransform, align_points, skew
from measure.model import Body, Camera

_ROUNDS = 30
_LONGEST_STEP_S = 0.1
_STEPS_A_ROUND = 2
_SETTLED_MM = 1e-3
_TOLERANCE = 1e-7
_HUBER_REACH = 2.5


@dataclass(frozen=True)
class RefineSettings:
    """What may change, and how far (standard deviations).

    Attributes:
        body_tolerance_mm: of each coordinate of a ball's centre in the body; 0 keeps the body.
        clock_tolerance_s: of a camera's clock against the first camera's; 0 trusts the stamps.
        position_tolerance_mm: of a camera whose calibration states no covariance.
        rotation_tolerance_deg: the same for its rotation.
        least_sd_px: no ball centre is believed better than this.
    """

    body_tolerance_mm: float = 0.05
    clock_tolerance_s: float = 0.02
    position_tolerance_mm: float = 2.0
    rotation_tolerance_deg: float = 0.3
    least_sd_px: float = 0.02


@dataclass(frozen=True, eq=False)
class RefinedState:
    """The unknowns."""

    cameras: tuple[Camera, ...]
    clocks_s: Floats
    centers: Floats
    world_from_body: RigidTransform


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined rig.

    Attributes:
        cameras: with covariances.
        clock_offsets_s: add to a camera's stamps to bring them in line with the first camera's.
        clock_sds_s: their standard deviations.
        centers: (k, 3) ball centres in the body, mm.
        center_sds: (k, 3) their standard deviations.
        rms_px: of the ball centres' residuals, before and after, by camera.
        noise_factor: by how much the stated standard deviations of ball centres were too small.
        frames: how many frame sets were used.
        covariance: of all cameras' poses and free lens parameters together.
        columns: by camera name, its rows in `covariance`.
    """

    cameras: tuple[Camera, ...]
    clock_offsets_s: dict[str, float]
    clock_sds_s: dict[str, float]
    centers: Floats
    center_sds: Floats
    rms_px: dict[str, tuple[float, float]]
    noise_factor: float
    frames: int
    covariance: Floats
    columns: dict[str, Ints] = field(default_factory=dict)


def refine_rig(
    cameras: tuple[Camera, ...],
    body: Body,
    recording: Recording,
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
) -> Refinement:
    """Refine cameras by bundle adjustment.

    Args:
        cameras: as calibrated; their covariances are the priors.
        body: nominal body.
        recording: what they saw.
        settings: what may change.
        joint_covariance: of all cameras' poses and free lens parameters together, camera after
            camera; it holds the world frame better than each camera's own, which ignores what their
            errors have in common.

    Raises:
        CalibrationError: a camera saw next to nothing, or the motion leaves something undetermined.
    """
    settings = settings or RefineSettings()
    for camera in cameras:
        seen = len(recording.tracks[camera.name].frame) if camera.name in recording.tracks else 0
        if seen < MIN_FRAMES:
            raise CalibrationError(
                f"camera {camera.name}: saw a ball {seen} times, at least {MIN_FRAMES} are needed"
            )
    problem = _Problem(cameras, body, recording, settings, joint_covariance)
    state = RefinedState(cameras, np.zeros(len(cameras)), body.centers, recording.world_from_body)
    before = problem.rms_px(state)
    factor = 1.0
    for _ in range(_ROUNDS):
        solution = problem.solve(state, factor)
        step = _largest_step(state, solution.state)
        state = solution.state
        update = _noise(solution)
        if abs(update - 1) < 0.01 and step < _SETTLED_MM:
            break
        factor *= update
    else:
        raise CalibrationError(f"the refinement did not settle in {_ROUNDS} rounds")
    if any(camera.pose_covariance is None for camera in cameras):
        solution = replace(solution, state=problem.held(solution.state))
    return problem.answer(solution, before, factor)


def _largest_step(old: RefinedState, new: RefinedState) -> float:
    """How far cameras and body poses moved, mm (a radian counts as the 100 mm it moves a ball)."""
    steps = [
        np.abs(new.world_from_body.difference(old.world_from_body)).max(axis=0),
        *(
            np.abs(b.world_from_camera.difference(a.world_from_camera))
            for a, b in zip(old.cameras, new.cameras, strict=True)
        ),
    ]
    return float(np.max(np.array(steps) * np.repeat([1.0, 100.0], 3)))


def _noise(solution: Solution[RefinedState]) -> float:
    """How much larger the residuals are than stated, by their median length."""
    lengths = np.concatenate(
        [np.linalg.norm(group.residuals, axis=1) for group in solution.linearised.groups]
    )
    lin = solution.linearised
    freedom = 1 - (lin.n_shared + 6 * lin.n_blocks) / (2 * len(lengths))
    # The median of a Rayleigh variable of sd 1 is 1.1774.
    return float(max(np.median(lengths) / 1.1774 / np.sqrt(max(freedom, 0.1)), 1e-3))


class _Problem:
    """The least-squares problem: which unknown is where, residuals and their derivatives."""

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        body: Body,
        recording: Recording,
        settings: RefineSettings,
        joint: Floats | None,
    ) -> None:
        self.first, self.body, self.recording, self.settings = cameras, body, recording, settings
        self.free = []
        self.columns: list[Ints] = []
        self.clock: list[int | None] = []
        size = 0
        # Frame sets too far apart say nothing about velocities, nor therefore about clocks.
        smooth = float(np.median(np.diff(recording.times_s))) < _LONGEST_STEP_S
        for number, camera in enumerate(cameras):
            P = camera.intrinsics.covariance
            free = np.flatnonzero(np.diag(P) > 0) if P is not None else np.zeros(0, dtype=np.int64)
            self.free.append(free)
            self.columns.append(np.arange(size, size + 6 + len(free)))
            size += 6 + len(free)
            has_clock = number > 0 and settings.clock_tolerance_s > 0 and smooth
            self.clock.append(size if has_clock else None)
            size += 1 if has_clock else 0
        self.centers: Ints | None = None
        if settings.body_tolerance_mm > 0:
            self.centers = np.arange(size, size + 3 * len(body.balls))
            size += 3 * len(body.balls)
        self.size = size
        self._prior = self._camera_prior(joint)
        self._roots = {
            name: _roots(track.covariance, settings.least_sd_px)
            for name, track in recording.tracks.items()
        }

    def solve(self, state: RefinedState, factor: float) -> Solution[RefinedState]:
        # The way between instants is held while solving, and taken anew in the next round.
        motion = Motion(self.recording.times_s, state.world_from_body, state.centers)
        return solve(
            lambda s: self.linearise(s, motion, factor),
            self.step,
            state,
            Huber(_HUBER_REACH),
            _STEPS_A_ROUND,
            _TOLERANCE,
            must_settle=False,
        )

    def held(self, state: RefinedState) -> RefinedState:
        """The state moved as a whole to where the first cameras see the body's balls on average.

        The motion says nothing about the world frame, and cameras whose calibration states no
        covariance have nothing else to hold it by.
        """
        start = RefinedState(self.first, state.clocks_s, state.centers, state.world_from_body)
        motion = Motion(self.recording.times_s, start.world_from_body, start.centers)

        def linearise(here: RefinedState) -> Linearised:
            full = self.linearise(here, motion, 1.0)
            groups = tuple(
                replace(
                    group,
                    columns=np.zeros(0, dtype=np.int64),
                    by_shared=np.zeros((*group.residuals.shape, 0)),
                )
                for group in full.groups
            )
            return Linearised(groups, 0, full.n_blocks, np.zeros(0), np.zeros((0, 0)))

        def step(here: RefinedState, _: Floats, blocks: Floats) -> RefinedState:
            return replace(here, world_from_body=here.world_from_body.perturb(blocks))

        before = solve(linearise, step, start, Huber(_HUBER_REACH), tolerance=_TOLERANCE).state
        first, now = (ball_places(s.world_from_body, s.centers) for s in (before, state))
        back = align_points(first, now)
        cameras = tuple(
            replace(camera, world_from_camera=back @ camera.world_from_camera)
            for camera in state.cameras
        )
        poses = RigidTransform(
            back.rotation @ state.world_from_body.rotation,
            back.apply(state.world_from_body.translation),
        )
        return replace(state, cameras=cameras, world_from_body=poses)

    def step(self, state: RefinedState, shared: Floats, blocks: Floats) -> RefinedState:
        cameras = tuple(
            changed(camera, shared[columns], free)
            for camera, columns, free in zip(state.cameras, self.columns, self.free, strict=True)
        )
        clocks = state.clocks_s + [0.0 if c is None else shared[c] for c in self.clock]
        centers = state.centers
        if self.centers is not None:
            centers = centers + shared[self.centers].reshape(-1, 3)
        return RefinedState(cameras, clocks, centers, state.world_from_body.perturb(blocks))

    def linearise(self, state: RefinedState, motion: Motion, factor: float) -> Linearised:
        groups = tuple(
            self._group(number, state, motion, factor) for number in range(len(state.cameras))
        )
        residuals, rows = self._priors(state)
        return Linearised(groups, self.size, len(self.recording.times_s), residuals, rows)

    def _group(self, number: int, state: RefinedState, motion: Motion, factor: float) -> Group:
        camera = state.cameras[number]
        track = self.recording.tracks[camera.name]
        poses = state.world_from_body
        rotation = poses.rotation[track.frame]
        arms = np.einsum("nij,nj->ni", rotation, state.centers[track.ball])
        lead = track.lead_s + state.clocks_s[number]
        moved, velocity = motion.at(track.frame, track.ball, lead)
        points = arms + poses.translation[track.frame] + moved
        predicted, by_world, by_camera, by_lens = camera.project_with_jacobians(points)
        shared, columns = [by_camera, by_lens[:, :, self.free[number]]], [self.columns[number]]
        clock = self.clock[number]
        if clock is not None:
            shared.append(by_world @ velocity[:, :, None])
            columns.append(np.array([clock]))
        if self.centers is not None:
            by_center = np.zeros((len(points), 3, len(self.centers)))
            for ball in range(len(state.centers)):
                mine = track.ball == ball
                by_center[mine, :, 3 * ball : 3 * ball + 3] = rotation[mine]
            shared.append(by_world @ by_center)
            columns.append(self.centers)
        roots = self._roots[camera.name] / factor
        by_pose = np.concatenate([by_world, -by_world @ skew(arms)], axis=2)
        residuals = np.einsum("nij,nj->ni", roots, track.pixels - predicted)
        return Group(
            residuals,
            np.concatenate(columns),
            roots @ np.concatenate(shared, axis=2),
            track.frame,
            roots @ by_pose,
        )

    def _priors(self, state: RefinedState) -> tuple[Floats, Floats]:
        residuals: list[Floats] = []
        rows: list[Floats] = []

        def add(residual: Floats, root: Floats, columns: Ints) -> None:
            row = np.zeros((len(root), self.size))
            row[:, columns] = root
            residuals.append(root @ residual)
            rows.append(row)

        s = self.settings
        back: list[Floats] = []
        for first, now, free, clock, offset in zip(
            self.first,
            state.cameras,
            self.free,
            self.clock,
            state.clocks_s,
            strict=True,
        ):
            change = intrinsics_vector(first.intrinsics) - intrinsics_vector(now.intrinsics)
            back.append(first.world_from_camera.difference(now.world_from_camera))
            back.append(change[free])
            if clock is not None:
                add(np.array([-offset]), np.eye(1) / s.clock_tolerance_s, np.array([clock]))
        add(np.concatenate(back), self._prior, np.concatenate(self.columns))
        if self.centers is not None:
            root = np.eye(len(self.centers)) / s.body_tolerance_mm
            add((self.body.centers - state.centers).reshape(-1), root, self.centers)
        return np.concatenate(residuals), np.concatenate(rows)

    def _camera_prior(self, joint: Floats | None) -> Floats:
        """Root of the information about all cameras' poses and free lens parameters."""
        size = sum(len(columns) for columns in self.columns)
        if joint is not None and joint.shape == (size, size):
            return _root_information(joint)
        P, row = np.zeros((size, size)), 0
        for camera, free in zip(self.first, self.free, strict=True):
            P[row : row + 6, row : row + 6] = self._pose_covariance(camera)
            lens, row = camera.intrinsics.covariance, row + 6
            if lens is not None and len(free):
                P[row : row + len(free), row : row + len(free)] = lens[np.ix_(free, free)]
            row += len(free)
        return _root_information(P)

    def _pose_covariance(self, camera: Camera) -> Floats:
        if camera.pose_covariance is not None and np.all(np.diag(camera.pose_covariance) > 0):
            return camera.pose_covariance
        s = self.settings
        turn = np.deg2rad(s.rotation_tolerance_deg)
        return np.diag(np.repeat([s.position_tolerance_mm**2, turn**2], 3))

    def rms_px(self, state: RefinedState) -> dict[str, float]:
        """RMS length of each camera's residuals with every body pose as it stands."""
        motion = Motion(self.recording.times_s, state.world_from_body, state.centers)
        out = {}
        for number, camera in enumerate(state.cameras):
            residuals = self._group(number, state, motion, 1.0).residuals
            pixels = np.linalg.solve(self._roots[camera.name], residuals[:, :, None])[:, :, 0]
            out[camera.name] = float(np.sqrt(np.mean(np.sum(pixels**2, axis=1))))
        return out

    def answer(
        self, solution: Solution[RefinedState], before: dict[str, float], factor: float
    ) -> Refinement:
        state, P = solution.state, solution.covariance
        after = self.rms_px(state)
        cameras = []
        for camera, columns, free in zip(state.cameras, self.columns, self.free, strict=True):
            mine = P[np.ix_(columns, columns)]
            lens = np.zeros((12, 12))
            lens[np.ix_(free, free)] = mine[6:, 6:]
            known = replace(camera.intrinsics, covariance=lens if len(free) else None)
            cameras.append(
                replace(
                    camera,
                    intrinsics=known,
                    pose_covariance=mine[:6, :6],
                    reprojection_rms_px=after[camera.name],
                )
            )
        used = np.concatenate(self.columns)
        starts = np.cumsum([0, *(len(c) for c in self.columns)])
        sds = np.zeros_like(state.centers)
        if self.centers is not None:
            sds = np.sqrt(np.diag(P)[self.centers]).reshape(-1, 3)
        clocks = {
            c.name: (float(o), 0.0 if i is None else float(np.sqrt(P[i, i])))
            for c, o, i in zip(cameras, state.clocks_s, self.clock, strict=True)
        }
        return Refinement(
            tuple(cameras),
            {name: offset for name, (offset, _) in clocks.items()},
            {name: sd for name, (_, sd) in clocks.items()},
            state.centers,
            sds,
            {name: (before[name], after[name]) for name in after},
            factor,
            len(self.recording.times_s),
            P[np.ix_(used, used)],
            {c.name: np.arange(a, b) for c, a, b in zip(cameras, starts, starts[1:], strict=False)},
        )


def _roots(covariance: Floats, least_sd_px: float) -> Floats:
    """Inverse Cholesky factors (n, 2, 2) of covariances with a floor."""
    floored = covariance + least_sd_px**2 * np.eye(2)
    return np.linalg.inv(np.linalg.cholesky(floored))


def _root_information(covariance: Floats) -> Floats:
    """R with R^T R the inverse of a covariance."""
    scale = 1 / np.sqrt(np.diag(covariance))
    correlation = covariance * scale[:, None] * scale
    return np.linalg.inv(np.linalg.cholesky(correlation + 1e-12 * np.eye(len(scale)))) * scale

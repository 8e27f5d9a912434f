"""Bundle adjustment from the moving body: the balls are the calibration wand.

Scale comes from the ball distances, the world frame from the first calibration. Estimated round
after round (`noise_model`) are the variances of detected centres, of their constant part, and, if
the first calibration states none, of its own errors: a recording that determines the cameras less
well than the first calibration leaves them as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Floats, Ints, rms_length
from measure.calibration.refining.priors import (
    USUAL_POSITION_MM,
    CameraPrior,
    NoiseModel,
    shrunken_variance,
    with_view_noise,
    workspace_grid,
)
from measure.calibration.refining.recording import BallMotion, Recording, ball_places
from measure.errors import CalibrationError
from measure.estimation.least_squares import LeastSquaresSolution, StoppingRule, solve
from measure.estimation.losses import HUBER_SIGMAS, Huber
from measure.estimation.rig_model import RigProblem, RigState, Views
from measure.limits import FEWEST
from measure.model import Body, Camera
from measure.model.body import USUAL_RADIUS_TOLERANCE_MM

_MAX_ROUNDS = 200
_UNDAMPED_ROUNDS = 12
_SETTLED_MM = 1e-3
_START_IMAGE_SD_PX = 5.0
"""Cameras start free, so that their errors are not attributed to the balls' constant shifts."""
_ONE_ROUND = StoppingRule(steps=2, tolerance=1e-7, must_settle=False, damping=1e-12)
"""Damping must be far below the prior of the world frame, which a long recording outweighs."""
_CLOCK_SD_S = 0.02  # Clocks that are off at all are off by something like this


@dataclass(frozen=True)
class RefineSettings:
    """What may change, and how far (standard deviations)."""

    # of each coordinate of a ball's centre in the body; 0 keeps the body. If None, what the body
    # states, or what is usual.
    body_tolerance_mm: float | None = None
    # how far a ball's centre usually sits off all through a recording, by axis.
    constant_px: float = 0.15
    least_sd_px: float = 0.02  # lower bound of a ball centre's standard deviation


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined rig."""

    cameras: tuple[Camera, ...]
    centers: Floats  # (k, 3) ball centres in the body, mm
    center_covariance: Floats  # (3k, 3k) of those; zero where the body is exact
    # of the ball centres' residuals, before and after, by camera.
    rms_px: dict[str, tuple[float, float]]
    misfit_px: dict[str, float]  # median length of the residuals after, by camera
    shifts_px: Floats  # (c, k, 2) by which each ball sits off in each camera all the time
    noise: NoiseModel
    change: Floats  # (p,) of all cameras' poses and free lens parameters
    covariance: Floats  # (p, p) of those after the recording
    prior: Floats  # (p, p) before it
    # by camera name, its rows in `covariance`.
    columns: dict[str, Ints] = field(default_factory=dict)
    frames: int = 0
    # whether the first calibration holds the joint covariance of all cameras.
    world_held: bool = False

    @property
    def center_sds(self) -> Floats:
        """Standard deviations (k, 3) of the ball centres, mm."""
        return np.sqrt(np.diag(self.center_covariance)).reshape(-1, 3)


def refine_rig(
    cameras: tuple[Camera, ...],
    body: Body,
    recording: Recording,
    settings: RefineSettings | None = None,
    joint_covariance: Floats | None = None,
    variance_factor: float = 1.0,
    clocks_are_exact: bool = True,
) -> Refinement:
    """Refine cameras by bundle adjustment.

    The joint covariance of all cameras' poses and free lens parameters, camera after camera, is the
    prior; without it their variances are estimated. `variance_factor` widens the views' variance
    (see `compare_halves`). CalibrationError: a camera saw next to nothing, or the motion leaves
    something undetermined.
    """
    settings = settings or RefineSettings()
    _check_seen(cameras, recording)
    tolerance_mm = settings.body_tolerance_mm
    if tolerance_mm is None:
        tolerance_mm = body.tolerance_mm or USUAL_RADIUS_TOLERANCE_MM
    places = ball_places(recording.world_from_body, body.centers)
    prior = CameraPrior(cameras, workspace_grid(places), joint_covariance)
    start = _start(cameras, body, recording)
    if not clocks_are_exact:
        clocks = {f"clock {camera.name}": np.zeros(1) for camera in cameras[1:]}
        start = replace(start, values={**start.values, **clocks})
    problem = _Refining(recording, start, tolerance_mm)
    return _settled(problem, prior, settings, variance_factor)


@dataclass(frozen=True, eq=False)
class _Refining:
    """Bundle adjustment of a recording: its balls are the points, its poses the instants' own.

    Unknown is a constant shift of every ball in every camera, too: light from one side displaces
    the edges of a ball always the same way. Without these shifts the covariance would shrink with
    the number of pictures although that error does not.
    """

    recording: Recording
    start: RigState
    body_tolerance_mm: float = 0.0  # 0 keeps the body

    @property
    def cameras(self) -> tuple[str, ...]:
        """The blocks of the cameras."""
        return tuple(f"camera {camera.name}" for camera in self.start.cameras)

    def about(self, state: RigState, prior: CameraPrior | None, noise: NoiseModel) -> RigProblem:
        """With the motion of a state, under a scatter; without a prior the cameras stay put."""
        views, extra = list[Views](), noise.view_px**2 * np.eye(2)
        for number, camera in enumerate(state.cameras):
            seen = self.recording.tracks[camera.name]
            covariance = noise.correlation * (seen.covariance + extra)
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            own = seen.frame, seen.ball, seen.pixels, root, seen.ball, seen.lead_s
            views.append(Views(number, *own))
        free, priors = dict[str, Ints](), dict[tuple[str, ...], Floats]()
        if prior is not None:
            free |= {f"camera {camera.name}": camera.free for camera in self.start.cameras}
            priors[self.cameras] = prior.root(noise)
            sds = {"offsets": noise.constant_px, "clock": _CLOCK_SD_S}
            for name, value in self.start.values.items():
                if sd := sds.get(name.split()[0], self.body_tolerance_mm):
                    free[name] = np.arange(value.size)
                    priors[name,] = np.eye(value.size) / sd
        motion = BallMotion(self.recording.times_s, state.poses, state.values["points"])
        return RigProblem(self.start, views, free, priors, True, motion.at)

    def solve(
        self, state: RigState, prior: CameraPrior | None, noise: NoiseModel
    ) -> LeastSquaresSolution[RigState]:
        """A few steps from a state, the motion held; without a prior the cameras stay put."""
        problem = self.about(state, prior, noise)
        # The correlation widens the covariances, but must not widen the reach of the loss.
        reach = HUBER_SIGMAS / np.sqrt(noise.correlation)
        return solve(problem.linearise, problem.step, state, Huber(float(reach)), _ONE_ROUND)

    def residuals_px(self, state: RigState) -> dict[str, Floats]:
        """By camera, what is left (n, 2) of its observations."""
        left = self.about(state, None, NoiseModel()).residuals_px(state)
        return {camera.name: own for camera, own in zip(state.cameras, left, strict=True)}


def _start(cameras: tuple[Camera, ...], body: Body, recording: Recording) -> RigState:
    """The cameras as calibrated, the body as nominal, nothing shifted."""
    shifts = {f"offsets {camera.name}": np.zeros((len(body.balls), 2)) for camera in cameras}
    return RigState(cameras, recording.world_from_body, {"points": body.centers, **shifts})


def _shifts_px(state: RigState) -> Floats:
    """Of each ball in each camera (c, k, 2)."""
    return np.stack([state.values[f"offsets {camera.name}"] for camera in state.cameras])


def _settled(
    problem: _Refining, prior: CameraPrior, settings: RefineSettings, variance_factor: float
) -> Refinement:
    """Alternate solving and estimating the noise until neither changes."""
    noise = NoiseModel(
        constant_px=settings.constant_px, image_px=_START_IMAGE_SD_PX, position_mm=USUAL_POSITION_MM
    )
    state = problem.start
    before = _rms(problem.residuals_px(problem.solve(state, None, noise).state))
    for number in range(_MAX_ROUNDS):
        solution = problem.solve(state, prior, noise)
        estimated = _estimated_noise(problem, prior, solution, noise, settings, variance_factor)
        settled = _largest_step(state, solution.state) < _SETTLED_MM
        state = solution.state
        if settled and not estimated.differs(noise):
            return _answer(problem, prior, solution, before, noise)
        noise = estimated if number < _UNDAMPED_ROUNDS else noise.towards(estimated)
    raise CalibrationError(
        f"the refinement did not settle in {_MAX_ROUNDS} rounds: record a longer motion through "
        "the whole workspace, or see with `measure check` whether clocks or shutters are off"
    )


def misfits_px(cameras: tuple[Camera, ...], body: Body, recording: Recording) -> Floats:
    """How far each sighting misses (n,) with these cameras and the nominal body, poses fitted."""
    problem = _Refining(recording, _start(cameras, body, recording))
    left = problem.residuals_px(problem.solve(problem.start, None, NoiseModel()).state)
    return np.linalg.norm(np.concatenate(list(left.values())), axis=1)


def _check_seen(cameras: tuple[Camera, ...], recording: Recording) -> None:
    for camera in cameras:
        seen = len(recording.tracks[camera.name].frame) if camera.name in recording.tracks else 0
        if seen < FEWEST:
            raise CalibrationError(
                f"camera {camera.name}: saw a ball {seen} times where the others do, at least "
                f"{FEWEST} are needed: is the body in its view, and does it stand where the "
                "first calibration says? `measure check` tells"
            )


def _largest_step(old: RigState, new: RigState) -> float:
    """How far cameras moved, mm (a radian counts as the 100 mm by which it shifts what is seen).

    Poses of the body at the recording's ends come to rest much later, and move no camera any more.
    """
    steps = [
        np.abs(b.world_from_camera.difference(a.world_from_camera))
        for a, b in zip(old.cameras, new.cameras, strict=True)
    ]
    return float(np.max(np.array(steps) * np.repeat([1.0, 100.0], 3)))


def _estimated_noise(
    problem: _Refining,
    prior: CameraPrior,
    solution: LeastSquaresSolution[RigState],
    noise: NoiseModel,
    settings: RefineSettings,
    variance_factor: float,
) -> NoiseModel:
    """The scatter that a solution shows."""
    state, lin = solution.state, solution.linearised
    unknown = lin.n_instants * lin.size_of_instant
    freedom = max(1 - unknown / lin.residuals.size, 0.1)
    residuals = problem.residuals_px(state)
    noise = with_view_noise(
        noise, residuals, problem.recording.tracks, freedom, settings.least_sd_px, variance_factor
    )
    shifts = solution.covariance_of(*(name for name in lin.sizes if name.startswith("offsets")))
    known = 1 - np.diag(shifts) / noise.constant_px**2
    squares = float(np.sum(_shifts_px(state) ** 2))
    constant = shrunken_variance(squares, float(np.sum(known)), settings.constant_px**2)
    noise = replace(noise, constant_px=float(np.sqrt(constant)))
    posterior = solution.covariance_of(*problem.cameras)
    return prior.estimate(noise, prior.change(state.cameras), posterior)


def _rms(residuals: dict[str, Floats]) -> dict[str, float]:
    return {name: rms_length(left) for name, left in residuals.items()}


def _answer(
    problem: _Refining,
    prior: CameraPrior,
    solution: LeastSquaresSolution[RigState],
    before: dict[str, float],
    noise: NoiseModel,
) -> Refinement:
    state = solution.state
    still = {name: value * (not name.startswith("offsets")) for name, value in state.values.items()}
    left = problem.residuals_px(replace(state, values=still))
    after = _rms(left)
    cameras = tuple(
        camera.with_covariance(
            solution.covariance_of(name), camera.intrinsics.free, after[camera.name]
        )
        for camera, name in zip(state.cameras, problem.cameras, strict=True)
    )
    centers = state.values["points"]
    known = np.zeros((centers.size, centers.size))
    if "points" in solution.linearised.sizes:
        known = solution.covariance_of("points")
    return Refinement(
        cameras,
        centers,
        known,
        {name: (before[name], after[name]) for name in after},
        {name: float(np.median(np.linalg.norm(own, axis=1))) for name, own in left.items()},
        _shifts_px(state),
        noise,
        prior.change(state.cameras),
        solution.covariance_of(*problem.cameras),
        prior.covariance_at(noise),
        {
            camera.name: solution.linearised.columns([name])
            for camera, name in zip(cameras, problem.cameras, strict=True)
        },
        len(problem.recording.times_s),
        prior.joint is not None,
    )

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
from measure.calibration.least_squares import LeastSquaresSolution
from measure.calibration.refining.priors import (
    USUAL_POSITION_MM,
    CameraPrior,
    NoiseModel,
    shrunken_variance,
    with_view_noise,
    workspace_grid,
)
from measure.calibration.refining.problem import RefinedState, RefineLayout, RefineProblem
from measure.calibration.refining.recording import Recording, ball_places
from measure.errors import CalibrationError
from measure.limits import FEWEST
from measure.model import Body, Camera
from measure.model.body import USUAL_RADIUS_TOLERANCE_MM

_MAX_ROUNDS = 200
_UNDAMPED_ROUNDS = 12
_SETTLED_MM = 1e-3
_START_IMAGE_SD_PX = 5.0
"""Cameras start free, so that their errors are not attributed to the balls' constant shifts."""


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
    layout = RefineLayout.of(cameras, len(body.balls), tolerance_mm == 0, clocks_are_exact)
    places = ball_places(recording.world_from_body, body.centers)
    prior = CameraPrior(cameras, layout.free, workspace_grid(places), joint_covariance)
    problem = RefineProblem(layout, body, tolerance_mm, recording)
    return _settled(problem, prior, problem.start(cameras), settings, variance_factor)


def _settled(
    problem: RefineProblem,
    prior: CameraPrior,
    first: RefinedState,
    settings: RefineSettings,
    variance_factor: float,
) -> Refinement:
    """Alternate solving and estimating the noise until neither changes."""
    noise = NoiseModel(
        constant_px=settings.constant_px, image_px=_START_IMAGE_SD_PX, position_mm=USUAL_POSITION_MM
    )
    before = _rms(problem.residuals_px(problem.solve(first, None, noise).state))
    state = first
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
    problem = RefineProblem(RefineLayout.of(cameras, len(body.balls), True), body, 0.0, recording)
    left = problem.residuals_px(problem.solve(problem.start(cameras), None, NoiseModel()).state)
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


def _largest_step(old: RefinedState, new: RefinedState) -> float:
    """How far cameras moved, mm (a radian counts as the 100 mm by which it shifts what is seen).

    Poses of the body at the recording's ends come to rest much later, and move no camera any more.
    """
    steps = [
        np.abs(b.world_from_camera.difference(a.world_from_camera))
        for a, b in zip(old.cameras, new.cameras, strict=True)
    ]
    return float(np.max(np.array(steps) * np.repeat([1.0, 100.0], 3)))


def _estimated_noise(
    problem: RefineProblem,
    prior: CameraPrior,
    solution: LeastSquaresSolution[RefinedState],
    noise: NoiseModel,
    settings: RefineSettings,
    variance_factor: float,
) -> NoiseModel:
    """The scatter that a solution shows."""
    state, P, layout = solution.state, solution.covariance, problem.layout
    lin = solution.linearised
    unknown = lin.n_blocks * lin.size_of_block
    freedom = max(1 - unknown / lin.residuals.size, 0.1)
    residuals = problem.residuals_px(state)
    noise = with_view_noise(
        noise, residuals, problem.recording.tracks, freedom, settings.least_sd_px, variance_factor
    )
    at = layout.shifts.reshape(-1)
    known = 1 - np.diag(P)[at] / noise.constant_px**2
    squares = float(np.sum(state.shifts_px**2))
    constant = shrunken_variance(squares, float(np.sum(known)), settings.constant_px**2)
    noise = replace(noise, constant_px=float(np.sqrt(constant)))
    own = np.concatenate(layout.cameras)
    change = prior.change(state.cameras, layout.free)
    return prior.estimate(noise, change, P[np.ix_(own, own)])


def _rms(residuals: dict[str, Floats]) -> dict[str, float]:
    return {name: rms_length(left) for name, left in residuals.items()}


def _answer(
    problem: RefineProblem,
    prior: CameraPrior,
    solution: LeastSquaresSolution[RefinedState],
    before: dict[str, float],
    noise: NoiseModel,
) -> Refinement:
    state, P, layout = solution.state, solution.covariance, problem.layout
    shifted = problem.residuals_px(replace(state, shifts_px=np.zeros_like(state.shifts_px)))
    after = _rms(shifted)
    cameras = tuple(
        camera.with_covariance(P[np.ix_(columns, columns)], free, after[camera.name])
        for camera, columns, free in zip(state.cameras, layout.cameras, layout.free, strict=True)
    )
    known = np.zeros((state.centers.size, state.centers.size))
    if len(layout.centers):
        known = P[np.ix_(layout.centers, layout.centers)]
    own = np.concatenate(layout.cameras)
    return Refinement(
        cameras,
        state.centers,
        known,
        {name: (before[name], after[name]) for name in after},
        {n: float(np.median(np.linalg.norm(left, axis=1))) for n, left in shifted.items()},
        state.shifts_px,
        noise,
        prior.change(state.cameras, layout.free),
        P[np.ix_(own, own)],
        prior.covariance_at(noise),
        {c.name: columns for c, columns in zip(cameras, layout.cameras, strict=True)},
        len(problem.recording.times_s),
        prior.joint is not None,
    )

"""Data sets of the simulated RAVEN-II, made the way real ones are: poses, log, one clock."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from measure.geometry import RigidTransform
from measure.host import Dataset, Report
from measure.host.interfaces import quiet
from measure.robots import RobotLog
from measure.session import Trajectory
from measure_learning.core.assemble import AssemblySettings, PoseTrack, TrajectoryFacts, assemble
from measure_learning.robots import raven_schema
from measure_learning.simulator import Cables, SimulatedRun, simulate

PAPER_MINUTES = 140.0
PAPER_PAIRS = 49_407
_LOG_HZ = 50.0
_NOISE_MM, _NOISE_RAD = 0.1, np.deg2rad(0.2)
_OFFSET_S = 1.5  # how far the robot's clock is ahead of the cameras'
_CUT = AssemblySettings(cut_s=210.0)


@dataclass(frozen=True)
class LabelKind:
    """What labels of a simulated run are.

    Attributes:
        exact: of the true tip at the true time, to judge by.
        rotations: of the tip's rotation, too.
    """

    exact: bool = False
    rotations: bool = False


def recording(
    run: SimulatedRun,
    name: str,
    seed: int,
    *,
    frame_hz: float,
    clock_offset_s: float = _OFFSET_S,
    noise_mm: float = _NOISE_MM,
    pairs: int | None = None,
    turn_noise_rad: float | None = None,
) -> tuple[PoseTrack, RobotLog]:
    """Poses, so many or as many as fit, and robot log that a simulated run would give.

    With a noise per axis of their rotations, these are measured, too.
    """
    rng = np.random.default_rng(seed)
    span = run.times_s[-1] - 0.2
    times = 0.1 + (np.arange(pairs) if pairs else np.arange(int(span * frame_hz))) / frame_hz
    truth = np.stack(
        [np.interp(times, run.times_s, run.world_from_tip.translation[:, i]) for i in range(3)],
        axis=1,
    )
    noise = rng.normal(0.0, noise_mm, truth.shape)
    covariances = np.tile(noise_mm**2 * np.eye(3), (len(times), 1, 1))
    track = PoseTrack(name, times, truth + noise, covariances)
    if turn_noise_rad is not None:
        turns = Trajectory(run.times_s, run.world_from_tip).at(times).rotation
        off = RigidTransform.from_rotvec(rng.normal(0.0, turn_noise_rad, truth.shape)).rotation
        variances = np.repeat([noise_mm**2, turn_noise_rad**2], 3)
        P = np.tile(np.diag(variances), (len(times), 1, 1))
        track = replace(track, rotations=off @ turns, pose_covariances=P)
    return track, RobotLog(raven_schema(), run.times_s + clock_offset_s, run.states)


def simulated_dataset(
    *,
    minutes: float = PAPER_MINUTES,
    pairs: int = PAPER_PAIRS,
    restarts: int = 4,
    seed: int = 1,
    cables: Cables | None = None,
    labels: LabelKind = LabelKind(),
    settings: AssemblySettings = _CUT,
    report: Report = quiet,
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Teleoperate the simulated robot in so many sessions, each after a restart.

    As in the paper, there are few sessions, and each is cut into trajectories.
    """
    if labels.exact:
        settings = replace(settings, clock_offset_s=_OFFSET_S, outlier_sds=np.inf, as_it_is=True)
    noise_mm, noise_rad = (0.0, 0.0) if labels.exact else (_NOISE_MM, _NOISE_RAD)
    seconds = 60.0 * minutes / restarts
    counts = np.diff(np.round(np.linspace(0, pairs, restarts + 1)).astype(int))
    recorded = []
    for index, count in enumerate(counts):
        report(index / restarts, f"session {index + 1} of {restarts}")
        run = simulate(seconds, 1000 * seed + index, log_hz=_LOG_HZ, cables=cables)
        name, hz = f"session_{seed}_{index:02d}", count / (seconds - 0.25)
        made = recording(
            run, name, seed + index, frame_hz=hz, noise_mm=noise_mm, pairs=int(count),
            turn_noise_rad=noise_rad if labels.rotations else None,
        )  # fmt: skip
        recorded.append(made)
    return assemble(recorded, settings)

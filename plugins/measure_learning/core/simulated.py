"""Data sets of the simulated RAVEN-II, made the way real ones are: poses, log, one clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.host import Dataset, Report
from measure.host.estimator import quiet
from measure.robots import RobotLog
from measure_learning.core.assemble import AssemblySettings, PoseTrack, TrajectoryFacts, assemble
from measure_learning.robots import raven_schema
from measure_learning.simulator import Cables, SimulatedRun, simulate

PAPER_MINUTES = 140.0
PAPER_PAIRS = 49_407
_LOG_HZ = 50.0
_NOISE_MM = 0.1
_OFFSET_S = 1.5  # how far the robot's clock is ahead of the cameras'
_CUT = AssemblySettings(cut_s=210.0)


def recording(
    run: SimulatedRun,
    name: str,
    seed: int,
    *,
    frame_hz: float,
    clock_offset_s: float = _OFFSET_S,
    noise_mm: float = _NOISE_MM,
    pairs: int | None = None,
) -> tuple[PoseTrack, RobotLog]:
    """Poses, so many or as many as fit, and robot log that a simulated run would give."""
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
    return track, RobotLog(raven_schema(), run.times_s + clock_offset_s, run.states)


def simulated_dataset(
    *,
    minutes: float = PAPER_MINUTES,
    pairs: int = PAPER_PAIRS,
    restarts: int = 4,
    seed: int = 1,
    cables: Cables | None = None,
    exact: bool = False,
    settings: AssemblySettings = _CUT,
    report: Report = quiet,
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Teleoperate the simulated robot in so many sessions, each after a restart.

    As in the paper, there are few sessions, and each is cut into trajectories.
    With `exact`, labels are those of the true tip at the true time: what to judge by.
    """
    if exact:
        settings = replace(settings, clock_offset_s=_OFFSET_S, outlier_sds=np.inf, as_it_is=True)
    noise_mm = 0.0 if exact else _NOISE_MM
    seconds = 60.0 * minutes / restarts
    counts = np.diff(np.round(np.linspace(0, pairs, restarts + 1)).astype(int))
    recorded = []
    for index, count in enumerate(counts):
        report(index / restarts, f"session {index + 1} of {restarts}")
        run = simulate(seconds, 1000 * seed + index, log_hz=_LOG_HZ, cables=cables)
        name, hz = f"session_{seed}_{index:02d}", count / (seconds - 0.25)
        made = recording(run, name, seed + index, frame_hz=hz, noise_mm=noise_mm, pairs=int(count))
        recorded.append(made)
    return assemble(recorded, settings)

"""Reported, measured and corrected positions of a robot's tip on one clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Bools, Floats
from measure.host import OnnxModel
from measure.learning.assemble import AssemblySettings, PoseTrack, assemble
from measure.learning.offline import correct, read_states
from measure.robots import LogFile, StateSchema


@dataclass(frozen=True, eq=False)
class RobotTraces:
    """Three positions of a robot's tip, in its base frame, at the instants of the poses."""

    times_s: Floats  # (n,) on the cameras' clock
    measured_mm: Floats  # (n, 3) by the cameras; NaN where not measured or unreliable
    reported_mm: Floats  # (n, 3) by the robot
    # (n, 3) reported plus the estimated error; NaN without a model, or where it refused.
    corrected_mm: Floats
    corrected_sd_mm: Floats  # (n,) of the correction, 3-D
    unfamiliar: Bools  # (n,) where the state is unlike the training states
    clock_offset_s: float  # robot minus camera time


def robot_traces(
    track: PoseTrack,
    log: Path,
    schema: StateSchema,
    model: OnnxModel | None = None,
    clock_offset_s: float | None = None,
) -> RobotTraces:
    """Reported, measured and corrected positions at the instants of the poses.

    The model gets every state of the log in order, as it does online; a correction holds until the
    next one.

    Args:
        clock_offset_s: robot minus camera time; estimated from the motion if absent.

    Raises:
        EstimatorError: the log or the model does not fit, or the clocks cannot be aligned.
    """
    settings = AssemblySettings(clock_offset_s)
    data, (facts,) = assemble([(track, LogFile(log, schema))], settings)
    offset = facts.clock.offset_s if facts.clock else clock_offset_s or 0.0
    reported = data.reported_mm
    errors, sd = np.full((len(data), 3), np.nan), np.full(len(data), np.nan)
    unfamiliar = np.zeros(len(data), dtype=bool)
    if model is not None:
        model.check(schema)
        times, corrected = correct(read_states(log, model), model)
        at = np.searchsorted(times, data.times_s, side="right") - 1
        began = at >= 0
        errors[began], sd[began] = corrected.errors_mm[at[began]], corrected.sd_mm[at[began]]
        unfamiliar[began] = corrected.unfamiliar[at[began]]
    measured = reported + np.where(data.usable[:, None], data.errors_mm, np.nan)
    return RobotTraces(
        data.times_s - offset, measured, reported, reported + errors, sd, unfamiliar, offset
    )

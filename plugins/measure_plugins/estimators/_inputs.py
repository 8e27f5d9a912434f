"""Which features say something about the robot's error."""

from __future__ import annotations

import numpy as np

from measure.arrays import Bools
from measure.host import Dataset

_RECORDING_SHARE = 0.3


def telling_features(data: Dataset) -> list[int]:
    """Columns that vary, and not mainly from recording to recording.

    A feature that is constant within a trajectory (an encoder offset, drawn anew at each restart)
    only tells the training trajectories apart: a net would learn them by heart. So a column is
    left out if over 30 % of its variance lies between trajectories, except those that joints (or,
    without joints, the position) are read from. A position that follows from the joints is left
    out, too.
    """
    varying, recording, needed = _kinds(data)
    if data.schema.chain is not None:  # the position is a function of the joints
        position = np.any(data.schema.reading_matrix(data.schema.position) != 0, axis=1)
        varying &= ~position | needed
    return [int(i) for i in np.flatnonzero(varying & (~recording | needed))]


def watched_features(data: Dataset) -> list[int]:
    """Columns that must resemble the training: all but those that only tell recordings apart."""
    _, recording, needed = _kinds(data)
    return [int(i) for i in np.flatnonzero(~recording | needed)]


def _kinds(data: Dataset) -> tuple[Bools, Bools, Bools]:
    """Columns that vary, that vary from recording to recording, and that positions come from."""
    schema, states = data.schema, data.states
    total = states.var(axis=0)
    means = np.array([states[rows].mean(axis=0) for _, rows in data.runs()])
    sizes = np.array([rows.stop - rows.start for _, rows in data.runs()])
    between = np.average((means - states.mean(axis=0)) ** 2, axis=0, weights=sizes)
    varying = total > (1e-6 * np.maximum(np.abs(states).max(axis=0), 1e-6)) ** 2
    recording = (between > _RECORDING_SHARE * total) & (len(means) > 1)
    needed = np.any(schema.reading_matrix(schema.joints or schema.position) != 0, axis=1)
    return varying, recording, needed

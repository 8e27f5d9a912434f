"""Data sets used together: they must be of one robot, described alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.errors import EstimatorError
from measure.host import Dataset


def join(parts: Sequence[Dataset]) -> Dataset:
    """One data set of several of the same robot; trajectory names must differ.

    Raises:
        EstimatorError: they are of several robots, have other features, or share a trajectory name.
    """
    same_robot(parts)
    names = tuple(name for part in parts for name in part.names)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise EstimatorError(f"two recordings are called '{twice}': rename one")
    shifts = np.cumsum([0, *(len(part.names) for part in parts[:-1])])
    return Dataset(
        parts[0].schema,
        np.concatenate([part.states for part in parts]),
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.trajectory + s for part, s in zip(parts, shifts, strict=True)]),
        names,
        np.concatenate([part.errors_mm for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.usable for part in parts]),
    )


def same_robot(parts: Sequence[Dataset]) -> None:
    """Refuse to use data of several robots together.

    Raises:
        EstimatorError: the robots or their features differ.
    """
    robots = {part.schema.robot for part in parts}
    if len(robots) > 1:
        raise EstimatorError(
            f"data of several robots cannot be used together: {', '.join(sorted(robots))}"
        )
    if any(part.schema.names != parts[0].schema.names for part in parts):
        raise EstimatorError(
            f"data of robot '{parts[0].schema.robot}' with other features, or in another order, "
            "cannot be used together: make all of them with one description of the robot"
        )

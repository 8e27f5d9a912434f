"""Errors of the tip's rotation as labels in mm, which estimators learn as they learn positions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.host.dataset import Dataset
from measure.robots import SerialChain

LEVER_MM = 100.0
"""A point so far from the tip moves by as much as a rotation counts beside a position."""


@dataclass(frozen=True, eq=False)
class TurnChain(SerialChain):
    """The chain of a data set whose labels are rotation vectors of the tip, times `LEVER_MM`."""


def turn_errors(measured: Floats, modelled: Floats) -> Floats:
    """Rotation vectors (n, 3), rad, with measured = exp(turn) modelled, both (n, 3, 3)."""
    return RigidTransform(measured @ np.swapaxes(modelled, -1, -2), np.zeros(3)).rotvec


def turns_as_errors(data: Dataset) -> Dataset | None:
    """The same rows with the rotation's errors, times the lever, as labels; None if it has none."""
    if (turns := data.turns) is None:
        return None
    chain = data.schema.chain
    if chain is not None:
        chain = TurnChain(chain.joints, chain.tool)
    return replace(
        data,
        schema=replace(data.schema, chain=chain),
        errors_mm=LEVER_MM * turns.vectors_rad,
        covariances=LEVER_MM**2 * turns.covariances,
        usable=data.usable & turns.known,
        turns=None,
    )

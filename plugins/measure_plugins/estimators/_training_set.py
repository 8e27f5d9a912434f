"""The training set of the nets of `stream`: inputs, and a robust loss at the tip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats, Ints
from measure.host import Dataset
from measure_plugins.estimators._kinematics import TorchTip

_SOFT_MM2 = 0.25  # of the pseudo-Huber loss: quadratic below half a millimetre, linear above


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Inputs and loss of the nets, as torch tensors.

    Attributes:
        inputs: (n, columns) scaled inputs, torch float32.
        loss: from row indices (...) and net outputs (..., outputs) to a mean loss.
        usable: (n,) rows with labels.
        starts: (runs,) first row of each trajectory.
        lengths: (runs,) rows of each trajectory.
        moving: columns of `inputs` whose differences between steps the GRUs also see.
        validate: from a function that maps inputs of one trajectory to outputs, to an RMS in mm.
    """

    inputs: Any
    loss: Callable[[Any, Any, Any], Any]
    usable: Any
    moving: list[int]
    starts: Ints
    lengths: Ints
    validate: Callable[[Callable[[Any], Any]], float]


@dataclass(frozen=True, eq=False)
class OutputUnits:
    """Units of a net's outputs.

    Attributes:
        scale: (outputs,) error in rad or mm of an output of one: joint errors where the chain is
            known, and a direct tip error (3).
        middle_mm: (3,) mean error, which is added to the net's output.
    """

    scale: Floats
    middle_mm: Floats


def make_training_set(
    data: Dataset,
    validation: Dataset,
    inputs: Callable[[Dataset], Floats],
    outputs: OutputUnits,
    moving: list[int],
) -> TrainingSet:
    """Tensors of training and validation trajectories; `inputs` scales them (n, columns)."""
    known, other = _Targets(data, outputs), _Targets(validation, outputs)
    weights, usable = _tensor(data.weights()), _bools(data.usable)
    inputs_other, usable_other = _tensor(inputs(validation)), _bools(validation.usable)

    def loss(rows: Any, out: Any, keep: Any) -> Any:
        each = ((known.residuals(rows, out) ** 2).sum(dim=-1) + _SOFT_MM2).sqrt()
        weight = weights[rows] if keep is None else weights[rows] * keep
        return (weight * each).sum() / weight.sum()

    def validate(forward: Any) -> float:
        total = 0.0
        for _, rows in validation.runs():
            left = other.residuals(rows, forward(inputs_other[rows]))[usable_other[rows]]
            total += float((left**2).sum())
        return float(np.sqrt(total / validation.usable.sum()))

    runs = [rows for _, rows in data.runs()]
    return TrainingSet(
        inputs=_tensor(inputs(data)),
        loss=loss,
        usable=usable,
        moving=moving,
        starts=np.array([rows.start for rows in runs]),
        lengths=np.array([rows.stop - rows.start for rows in runs]),
        validate=validate,
    )


class _Targets:
    """Labels of a data set, and their residuals after a net's outputs."""

    def __init__(self, data: Dataset, outputs: OutputUnits) -> None:
        self._scale = _tensor(outputs.scale)
        self._labels = _tensor(data.errors_mm - outputs.middle_mm)
        self._tip = None if data.schema.chain is None else TorchTip(data.schema.chain)
        self._q = _tensor(data.joints)
        self._base = None if self._tip is None else self._tip(self._q)

    def residuals(self, rows: Any, out: Any) -> Any:
        """(..., 3) mm of some rows (...), for outputs (..., outputs)."""
        scaled = out * self._scale
        if self._tip is None or self._base is None:
            return scaled - self._labels[rows]
        moved = self._tip(self._q[rows] + scaled[..., :-3]) - self._base[rows]
        return moved + scaled[..., -3:] - self._labels[rows]


def _tensor(values: Floats) -> Any:
    import torch

    return torch.tensor(np.nan_to_num(values), dtype=torch.float32)


def _bools(values: Any) -> Any:
    import torch

    return torch.tensor(values)

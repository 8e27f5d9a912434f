"""The training set of the nets of `stream`: inputs, and a robust loss at the tip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats, Ints
from measure.host import Dataset
from measure.host.dataset import recording_of
from measure.robots import StateSchema
from measure_learning.onnx import Graph, Value
from measure_learning.onnx.kinematics import TorchTip, levers, tip_error

_TURN_RAD, _SLIDE_MM = 0.05, 1.0  # joint errors (and of a tip) of an output of one
_SOFT_MM2 = 0.25  # of the pseudo-Huber loss: quadratic below half a millimetre, linear above
_PULL = 0.03  # of the loss, per mm^2 that a recording's offsets move the tip


@dataclass(frozen=True, eq=False)
class OutputUnits:
    """Units of a net's outputs: joint errors where the chain is known, and a direct tip error."""

    scale: Floats  # (outputs,) rad or mm of an output of one
    reach_mm: Floats  # (outputs,) how far an output of one moves the tip, RMS
    middle_mm: Floats  # (3,) mean error, which is added to the net's output

    @classmethod
    def of(cls, data: Dataset) -> OutputUnits:
        """Of training trajectories."""
        chain, used = data.schema.chain, data.usable
        turns = [] if chain is None else [not joint.prismatic for joint in chain.joints]
        scale = np.where([*turns, False, False, False], _TURN_RAD, _SLIDE_MM)
        units = levers(data.rows(used))[1]
        reach = np.divide(scale, units, out=np.zeros_like(scale), where=units > 0)
        middle = np.average(data.errors_mm[used], axis=0, weights=data.weights()[used])
        return cls(scale, reach, middle)

    def error_in_graph(
        self, graph: Graph, schema: StateSchema, features: Value, outputs: Value
    ) -> Value:
        """Tip error (N, 3) mm of a net's outputs (N, outputs)."""
        scaled = graph.op("Mul", outputs, self.scale)
        return graph.op("Add", tip_error(graph, schema, features, scaled), self.middle_mm)


class TrainingSet:
    """Inputs and loss of the nets, as torch tensors.

    Attributes:
        inputs: (n, columns) scaled inputs, torch float32.
        usable: (n,) rows with labels.
        moving: columns of `inputs` whose differences between steps the nets also see.
        starts: (runs,) first row of each trajectory.
        lengths: (runs,) rows of each trajectory.
    """

    def __init__(
        self,
        data: Dataset,
        validation: Dataset,
        inputs: Callable[[Dataset], Floats],
        outputs: OutputUnits,
        moving: list[int],
    ) -> None:
        """Of training and validation trajectories; `inputs` scales them (n, columns)."""
        self._known, self._other = Targets(data, outputs), Targets(validation, outputs)
        self.inputs, self._inputs_other = _tensor(inputs(data)), _tensor(inputs(validation))
        self._weights, self.moving = _tensor(data.weights()), moving
        self._reach = _tensor(outputs.reach_mm)
        recordings = np.unique([recording_of(n) for n in data.names], return_inverse=True)[1]
        self._recording = _tensor(recordings[data.trajectory], np.int64)
        self._shares = _tensor(np.bincount(recordings[data.trajectory]) / len(data))
        self.usable, self._validation = _tensor(data.usable, bool), validation
        runs = [rows for _, rows in data.runs()]
        self.starts: Ints = np.array([rows.start for rows in runs])
        self.lengths: Ints = np.array([rows.stop - rows.start for rows in runs])

    def offsets(self) -> Any:
        """Constant errors of each recording's outputs (recordings, outputs), still zero.

        How joints were homed and cameras registered, no state shows: a net that need not explain
        it learns better what is common. They are trained with the net, and not part of it.
        """
        return self._reach.new_zeros(len(self._shares), len(self._reach)).requires_grad_()

    def loss(self, rows: Any, out: Any, offsets: Any, keep: Any = None) -> Any:
        """Mean loss of net outputs (..., outputs) for row indices (...); some are kept.

        What the offsets have in common is the net's; of a single recording, everything.
        """
        off = (offsets - self._shares @ offsets)[self._recording[rows]]
        each = ((self._known.residuals(rows, out + off) ** 2).sum(dim=-1) + _SOFT_MM2).sqrt()
        weight = self._weights[rows] if keep is None else self._weights[rows] * keep
        pull = ((off * self._reach) ** 2).sum(dim=-1).mean()
        return (weight * each).sum() / weight.sum() + _PULL * pull

    def validate(self, forward: Callable[[Any], Any]) -> float:
        """RMS in mm of a function that maps inputs of one validation trajectory to outputs."""
        total = 0.0
        for _, rows in self._validation.runs():
            left = self._other.residuals(rows, forward(self._inputs_other[rows]))
            total += float((left[self._validation.usable[rows]] ** 2).sum())
        return float(np.sqrt(total / self._validation.usable.sum()))


class Targets:
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
        moved = self._tip.change(self._tip(self._q[rows] + scaled[..., :-3]), self._base[rows])
        return moved + scaled[..., -3:] - self._labels[rows]


def _tensor(values: Any, kind: type = np.float32) -> Any:
    import torch

    return torch.from_numpy(np.nan_to_num(values).astype(kind))

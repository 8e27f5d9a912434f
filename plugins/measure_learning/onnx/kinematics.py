"""From joint errors to tip errors through the forward kinematics: by slopes, in torch, in ONNX.

An estimator's outputs are errors of the joints where the chain is known, and a direct tip error.
The tip error is that of the rotation, times a lever, where the chain is a `TurnChain`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset
from measure.robots import SerialChain, StateSchema
from measure_learning.onnx.graph import Graph, Value
from measure_learning.onnx.rotation import LEVER_MM, TurnChain


def levers(data: Dataset) -> tuple[Floats, Floats]:
    """Tip errors of outputs: slopes (n, 3, outputs), and what the outputs are counted in.

    The units (outputs,) in rad and mm make each output move the tip by 1 mm RMS over these rows;
    one that never moves it has a unit of zero.
    """
    slopes = tip_slopes(data)
    reach = np.sqrt((slopes**2).sum(axis=1).mean(axis=0))
    units = np.divide(1.0, reach, out=np.zeros_like(reach), where=reach > 0)
    return slopes * units, units


def tip_slopes(data: Dataset) -> Floats:
    """Motion of the tip by each output, (n, 3, outputs), per rad and mm."""
    shift = np.tile(np.eye(3), (len(data), 1, 1))
    if (chain := data.schema.chain) is None:
        return shift
    slopes = chain.jacobian(data.joints)
    moved = LEVER_MM * slopes[:, 3:] if isinstance(chain, TurnChain) else slopes[:, :3]
    return np.concatenate([moved, shift], axis=2)


class TorchTip:
    """`tip(q)` of a chain, its place or its rotation's axes, differentiable, in float32."""

    def __init__(self, chain: SerialChain) -> None:
        import torch

        self._torch = torch
        self._parts = [torch.tensor(part, dtype=torch.float32) for part in chain.parts]
        self._turns = isinstance(chain, TurnChain)

    def __call__(self, q: Any) -> Any:
        """Q (..., joints) in rad and mm -> (..., 3) mm, or axes (..., 3, 3) of a `TurnChain`."""
        constant, cosine, sine, linear = self._parts
        angle = q[..., None, None]
        steps = (
            constant
            + cosine * self._torch.cos(angle)
            + sine * self._torch.sin(angle)
            + linear * angle
        )
        point = steps[..., -1, :, :3] if self._turns else steps[..., -1, :, 3:]
        for index in range(q.shape[-1] - 2, -1, -1):
            point = steps[..., index, :, :] @ point
        return point[..., :3, :] if self._turns else point[..., :3, 0]

    def change(self, tip: Any, before: Any) -> Any:
        """What labels measure (..., 3) mm, from the tip `before` to another."""
        if not self._turns:
            return tip - before
        sines = 0.5 * self._torch.linalg.cross(before, tip, dim=-2).sum(dim=-1)
        return LEVER_MM * sines * (1.0 + (sines**2).sum(dim=-1, keepdim=True) / 6.0)


def tip_error(graph: Graph, schema: StateSchema, features: Value, outputs: Value) -> Value:
    """Tip error (N, 3) mm of outputs."""
    if schema.chain is None:
        return outputs
    joints = schema.chain.size
    turned = tip_change(graph, schema, features, graph.columns(outputs, range(joints)))
    return graph.op("Add", turned, graph.columns(outputs, range(joints, joints + 3)))


def tip_change(graph: Graph, schema: StateSchema, features: Value, joint_errors: Value) -> Value:
    """FK(q + dq) - FK(q), (N, 3) mm, q read from the raw state."""
    assert schema.chain is not None
    q = graph.op("MatMul", features, schema.reading_matrix(schema.joints))
    pair = graph.op("Concat", graph.op("Add", q, joint_errors), q, axis=1)
    angle = graph.reshape(pair, -1, schema.chain.size, 1, 1)
    return _between(graph, schema.chain, schema.chain.parts, angle)


def chain_change(graph: Graph, schema: StateSchema, features: Value, bent: SerialChain) -> Value:
    """Tip of `bent` minus that of the schema's chain, (N, 3) mm, q read from the raw state."""
    assert schema.chain is not None
    q = graph.op("MatMul", features, schema.reading_matrix(schema.joints))
    angle = graph.reshape(q, -1, 1, schema.chain.size, 1, 1)
    pairs = zip(bent.parts, schema.chain.parts, strict=True)
    return _between(graph, schema.chain, tuple(np.stack(pair) for pair in pairs), angle)


def tip_place(graph: Graph, schema: StateSchema, features: Value) -> Value:
    """FK(q), (N, 3) mm, q read from the raw state."""
    assert schema.chain is not None
    q = graph.op("MatMul", features, schema.reading_matrix(schema.joints))
    angle = graph.reshape(q, -1, schema.chain.size, 1, 1)
    point = _carried(graph, schema.chain.parts, angle, 3, 4)
    return graph.columns(graph.reshape(point, -1, 4), range(3))


def _between(graph: Graph, chain: SerialChain, parts: tuple[Floats, ...], angle: Value) -> Value:
    """First minus second tip (N, 3) of pairs of chains, whose angles are (..., joints, 1, 1)."""
    if isinstance(chain, TurnChain):
        axes = _carried(graph, parts, angle, 0, 3)
        return _turn_between(graph, graph.reshape(axes, -1, 2, 4, 3))
    point = _carried(graph, parts, angle, 3, 4)
    # (2N, 1, 4, 1) or (N, 2, 1, 4, 1) -> (N, 8): x y z 1 of both
    return graph.op(
        "MatMul", graph.reshape(point, -1, 8), np.concatenate([np.eye(4, 3), -np.eye(4, 3)])
    )


def _carried(graph: Graph, parts: tuple[Floats, ...], angle: Value, first: int, stop: int) -> Value:
    """Columns (..., 1, 4, columns) of the tip's transform, `first` to `stop` of the four."""
    constant, cosine, sine, linear = parts
    steps = graph.op("Add", graph.op("Mul", graph.op("Cos", angle), cosine), constant)
    steps = graph.op("Add", steps, graph.op("Mul", graph.op("Sin", angle), sine))
    if np.any(linear):
        steps = graph.op("Add", steps, graph.op("Mul", angle, linear))
    each = graph.ops("Split", constant.shape[-3], steps, axis=-3)
    point = graph.op("Slice", each[-1], *(graph.constant([v], np.int64) for v in (first, stop, -1)))
    for step in reversed(each[:-1]):
        point = graph.op("MatMul", step, point)
    return point


def _turn_between(graph: Graph, axes: Value) -> Value:
    """Rotation vector (N, 3), times the lever, of the first of axes (N, 2, 4, 3) from the second.

    Its sine is half the sum of the axes' cross products; an arc sine's first two terms are enough.
    """
    now, before = graph.ops("Split", 2, axes, axis=1)
    turned = graph.op("MatMul", now, graph.op("Transpose", before, perm=[0, 1, 3, 2]))
    picked = np.zeros((4, 4, 3))
    for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        picked[i, j, axis], picked[j, i, axis] = 0.5, -0.5
    sines = graph.op("MatMul", graph.reshape(turned, -1, 16), picked.reshape(16, 3))
    square = graph.op("ReduceSumSquare", sines, axes=[1], keepdims=1)
    stretch = graph.affine(square, np.array([[LEVER_MM / 6.0]]), LEVER_MM)
    return graph.op("Mul", sines, stretch)

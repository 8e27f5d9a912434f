"""A small builder of ONNX graphs: operations are method calls, arrays become constants.

A finished model ends with a checksum. A serialised protobuf message may be continued by appending
fields, so the model is followed by one more entry of its metadata, `sha256` of all bytes before it;
any ONNX runtime reads it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.processes import needed

Value: TypeAlias = str
"""The name of a tensor inside a graph."""

OPSET = 17
ML_OPSET = 3
# Field 14 of ModelProto (metadata_props), an entry of 74 bytes: key `sha256`, a value of 64 bytes.
_CHECKSUM_HEAD = b"\x72\x4a\x0a\x06sha256\x12\x40"


def seal(body: bytes) -> bytes:
    """A serialised model with its checksum."""
    return body + _CHECKSUM_HEAD + hashlib.sha256(body).hexdigest().encode()


def is_intact(content: bytes) -> bool:
    """Whether a file ends with the checksum of all bytes before it."""
    return content == seal(content[: -len(_CHECKSUM_HEAD) - 64])


class Graph:
    """Collects nodes and constants; every method returns the name of its result.

    Operands are names of tensors, or arrays and numbers, which become float32 constants.
    """

    def __init__(self, prefix: str = "") -> None:
        """The names of results begin with `prefix`, where a model has names already."""
        self._onnx = needed("onnx", "train", "writing a model", EstimatorError)
        self._prefix = prefix
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, value: ArrayLike, dtype: type = np.float32) -> Value:
        """A tensor that never changes."""
        name = f"{self._prefix}c{len(self._constants)}"
        array: Any = np.ascontiguousarray(np.asarray(value), dtype=dtype)
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def op(
        self, kind: str, *operands: Value | ArrayLike, domain: str = "", **attributes: Any
    ) -> Value:
        """One operator with one result."""
        return self.ops(kind, 1, *operands, domain=domain, **attributes)[0]

    def ops(
        self,
        kind: str,
        results: int,
        *operands: Value | ArrayLike,
        domain: str = "",
        **attributes: Any,
    ) -> list[Value]:
        """One operator with several results."""
        at = f"{self._prefix}t{len(self._nodes)}"
        names = [f"{at}_{index}" for index in range(results)]
        inputs = [x if isinstance(x, str) else self.constant(x) for x in operands]
        self._nodes.append(
            self._onnx.helper.make_node(kind, inputs, names, domain=domain, **attributes)
        )
        return names

    def affine(self, x: Value, weight: Floats, bias: ArrayLike) -> Value:
        """`x @ weight + bias`; leading axes of `weight` are members of an ensemble."""
        return self.op("Add", self.op("MatMul", x, weight), bias)

    def columns(self, x: Value, indices: Sequence[int]) -> Value:
        """Some columns of (N, columns)."""
        picked = self.constant(list(indices), np.int64)
        return self.op("Gather", x, picked, axis=-1)

    def reshape(self, x: Value, *shape: int) -> Value:
        """The same numbers in another shape; 0 keeps an axis, -1 takes what is left."""
        return self.op("Reshape", x, self.constant(shape, np.int64))

    def total(self, x: Value, axis: int, *, mean: bool = False) -> Value:
        """Sum or mean over one axis, which disappears."""
        if mean:
            return self.op("ReduceMean", x, axes=[axis], keepdims=0)
        return self.op("ReduceSum", x, self.constant([axis], np.int64), keepdims=0)

    def mix(self, tick: Value, new: Value, old: Value) -> Value:
        """`new` where tick is one, `old` where it is zero."""
        return self.op("Add", old, self.op("Mul", tick, self.op("Sub", new, old)))

    def ones_like(self, x: Value) -> Value:
        """A tensor of ones in the shape of x."""
        return self.op("Add", self.op("Mul", x, np.float32(0.0)), np.float32(1.0))

    def build(
        self,
        inputs: Mapping[str, int],
        outputs: Mapping[str, tuple[Value, tuple[int, ...]]],
        metadata: Mapping[str, Any],
        doc: str = "",
    ) -> bytes:
        """The finished model, checked and sealed.

        Args:
            inputs: names and widths of inputs (N, width).
            outputs: names, the tensors they come from, and their shapes after N.
            metadata: stored as JSON texts.
            doc: what the file says of itself.
        """
        helper, kinds = self._onnx.helper, self._onnx.TensorProto
        renamed = [
            helper.make_node("Identity", [value], [name]) for name, (value, _) in outputs.items()
        ]
        graph = helper.make_graph(
            [*self._nodes, *renamed],
            "estimator",
            [helper.make_tensor_value_info(n, kinds.FLOAT, ["N", w]) for n, w in inputs.items()],
            [
                helper.make_tensor_value_info(n, kinds.FLOAT, ["N", *s])
                for n, (_, s) in outputs.items()
            ],
            self._constants,
        )
        imports = [helper.make_opsetid("", OPSET), helper.make_opsetid("ai.onnx.ml", ML_OPSET)]
        model = helper.make_model(
            graph, opset_imports=imports, producer_name="triball", ir_version=9, doc_string=doc
        )
        helper.set_model_props(model, {key: json.dumps(text) for key, text in metadata.items()})
        self._onnx.checker.check_model(model)
        return seal(model.SerializeToString())

    def extend(
        self, content: bytes, outputs: Mapping[str, Value], metadata: Mapping[str, Any]
    ) -> bytes:
        """A finished model that goes on with this graph, sealed anew; see `before`.

        Args:
            content: the model, as `build` made it.
            outputs: names of outputs that it has, and the tensors that they are from now on.
            metadata: entries that replace those of their names, stored as JSON texts.
        """
        helper, model = self._onnx.helper, self._onnx.load_model_from_string(content)
        for node in model.graph.node:
            node.output[:] = [self.before(n) if n in outputs else n for n in node.output]
        ends = [helper.make_node("Identity", [value], [name]) for name, value in outputs.items()]
        model.graph.node.extend([*self._nodes, *ends])
        model.graph.initializer.extend(self._constants)
        held = {entry.key: entry.value for entry in model.metadata_props if entry.key != "sha256"}
        held |= {key: json.dumps(value) for key, value in metadata.items()}
        helper.set_model_props(model, held)
        self._onnx.checker.check_model(model)
        return seal(model.SerializeToString())

    def before(self, name: str) -> Value:
        """An output that `extend` changes, as it was."""
        return f"{self._prefix}before_{name}"

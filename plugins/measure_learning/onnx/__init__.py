"""Estimators as ONNX files: how one is built, judged, written and run."""

from measure_learning.onnx.checkpoint import Checkpoint
from measure_learning.onnx.estimator import OnnxEstimator
from measure_learning.onnx.fit import Core
from measure_learning.onnx.graph import Graph, Value, seal
from measure_learning.onnx.judging import Scaling
from measure_learning.onnx.model import Corrections, Estimates, OnnxModel

__all__ = [
    "Checkpoint", "Core", "Corrections", "Estimates", "Graph", "OnnxEstimator", "OnnxModel",
    "Scaling", "Value", "seal",
]  # fmt: skip

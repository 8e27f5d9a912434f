"""A robot's position error learnt from its states: logs, data sets, training, correction.

`load` runs a trained model. `measure_learning.api` holds what a notebook calls, one function an
action.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from measure_learning.onnx import OnnxModel

__all__ = ["SHIPPED", "load"]

SHIPPED = Path(__file__).parent / "core" / "models" / "raven_simulated.onnx"
"""The network that comes with this package, trained on the simulated RAVEN-II."""


def load(path: Path | str) -> OnnxModel:
    """A model that `measure train` wrote, or `shipped`, the one that comes along.

    EstimatorError: missing, damaged, or not a model.
    """
    from measure_learning.onnx import OnnxModel

    return OnnxModel.load(SHIPPED if str(path) == "shipped" else Path(path))

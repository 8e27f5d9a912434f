"""Corrects a robot's states with a model of `measure train`: onnxruntime and numpy alone."""

import json

import numpy as np
import onnxruntime


class Corrector:
    """One trajectory; make another after a pause."""

    def __init__(self, model):
        self.session = onnxruntime.InferenceSession(model)
        facts = json.loads(self.session.get_modelmeta().custom_metadata_map["measure"])
        self.memory = np.zeros((1, self.session.get_inputs()[1].shape[1]), np.float32)
        self.period_s, self.ticked_s = facts["period_s"], -np.inf

    def correct(self, state, time_s):
        """Error in mm to add to the tip, its covariance, strangeness; `turn_rad` if it is there."""
        tick = time_s - self.ticked_s >= 0.75 * self.period_s
        self.ticked_s = time_s if tick else self.ticked_s
        rows = {"features": np.float32([state]), "tick": np.float32([[tick]])}
        made = self.session.run(None, {**rows, "memory": self.memory})
        out = dict(zip((one.name for one in self.session.get_outputs()), made, strict=True))
        self.memory = out["memory_out"]
        turn = [out[name][0] for name in ("turn_rad", "turn_covariance") if name in out]
        covariance = out["covariance"].reshape(3, 3)
        return out["error_mm"][0], covariance, out["strangeness"][0, 0], *turn

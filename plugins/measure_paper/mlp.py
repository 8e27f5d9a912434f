"""The paper's network: 600-500-400 sigmoid units on the whole state, without a memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import field_validator

from measure import host
from measure.arrays import Floats
from measure.errors import EstimatorError
from measure_learning import onnx


class MlpSettings(host.Settings):
    """Settings of `mlp`; the defaults are the paper's, but for learning rate, epochs and penalty.

    The paper states a learning rate of 1e-8. Adam moves a weight by at most about the rate at each
    step, so 10 000 epochs of 44 batches would move it by 0.004: that cannot train such a network
    (docs/explanation/learning.md shows it). Its penalty, 5e-6, lets ours overfit.
    """

    layers: tuple[int, ...] = host.setting((600, 500, 400), "Units of each hidden layer.")
    learning_rate: float = host.setting(
        1e-2, "Learning rate of Adam at the peak of its one cycle; the paper states 1e-8.", gt=0
    )
    epochs: int = host.setting(
        80, "Largest number of passes over the data, at which the cycle of the rate ends.", ge=1
    )
    patience: int = host.setting(
        40, "Training stops after this many epochs without a better validation error.", ge=1
    )
    batch: int = host.setting(1024, "Number of rows of a batch.", ge=2)
    l1: float = host.setting(2e-4, "L1 penalty on the weights; the paper's is 5e-6.", ge=0)

    @field_validator("layers")
    @classmethod
    def _layers_have_units(cls, layers: tuple[int, ...]) -> tuple[int, ...]:
        if min(layers, default=1) < 1:
            raise ValueError("a layer needs at least one unit")
        return layers


class MlpEstimator(onnx.OnnxEstimator):
    """The paper's perceptron: three sigmoid layers with batch normalisation, L1 and Adam."""

    name = "mlp"
    Config = MlpSettings
    config: MlpSettings
    memoryless = True

    def learn(
        self, data: host.Dataset, validation: host.Dataset, *, seed: int, report: host.Report
    ) -> None:
        """Train with early stopping; the best epoch on the validation trajectories is kept."""
        torch = host.needed("torch", "train", "training", EstimatorError)
        torch.set_num_threads(1)
        c = self.config
        self._scaling = onnx.Scaling.of(data.states)
        other = _tensors(torch, validation, self._scaling)
        fit = _MlpTraining(torch, _tensors(torch, data, self._scaling), c, seed)
        key = seed, c.model_dump(mode="json"), data.digest(), validation.digest()
        saved = onnx.Checkpoint(self.checkpoint, "mlp", key)
        saved.load(fit.restore)
        for epoch in range(len(fit.curve), c.epochs):
            score = fit.epoch(epoch, other)
            report((epoch + 1) / c.epochs, f"epoch {epoch + 1}: {score:.3f} mm")
            saved.store(**fit.state())
            if epoch - fit.best[1] >= c.patience:
                break
        self.curve = tuple(fit.curve)
        self._layers = _fold(fit.best_net())

    def compute(
        self, graph: onnx.Graph, features: onnx.Value, memory: onnx.Value, tick: onnx.Value
    ) -> onnx.Core:
        """Dense layers; batch normalisation is folded into them."""
        x = self._scaling.in_graph(graph, features)
        for index, (weight, bias) in enumerate(self._layers):
            x = graph.op("Gemm", x, weight, bias)
            if index < len(self._layers) - 1:
                x = graph.op("Sigmoid", x)
        return onnx.Core(x)


def _network(torch: Any, inputs: int, config: MlpSettings) -> Any:
    parts, width = [], inputs
    for units in config.layers:
        parts += [torch.nn.Linear(width, units), torch.nn.Sigmoid(), torch.nn.BatchNorm1d(units)]
        width = units
    return torch.nn.Sequential(*parts, torch.nn.Linear(width, 3))


def _tensors(torch: Any, data: host.Dataset, scaling: onnx.Scaling) -> tuple[Any, Any, Any]:
    used = data.usable
    return tuple(
        torch.tensor(values[used], dtype=torch.float32)
        for values in (scaling.apply(data.states), data.errors_mm, data.weights())
    )


class _MlpTraining:
    """Training under way: network, optimiser, schedule, curve and the best epoch so far."""

    def __init__(
        self, torch: Any, rows: tuple[Any, Any, Any], config: MlpSettings, seed: int
    ) -> None:
        self._torch, self._rows, self._config = torch, rows, config
        self._dice = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self._net = _network(torch, rows[0].shape[1], config)
        self._size = min(config.batch, len(rows[0]))
        rate = config.learning_rate
        self._optimiser = torch.optim.Adam(self._net.parameters(), lr=rate, eps=1e-8)
        self._plan = torch.optim.lr_scheduler.OneCycleLR(
            self._optimiser,
            rate,
            total_steps=config.epochs * (len(rows[0]) // self._size) + 1,
            pct_start=0.1,
            cycle_momentum=False,  # the paper's betas
        )
        self._parts = {"net": self._net, "optimiser": self._optimiser, "plan": self._plan}
        self.curve: list[host.Epoch] = []
        self.best: tuple[float, int, Any] = (np.inf, 0, None)

    def epoch(self, epoch: int, other: tuple[Any, Any, Any]) -> float:
        """One pass over the data; the RMS on other rows."""
        order = self._torch.randperm(len(self._rows[0]), generator=self._dice)
        starts = range(0, len(order) - self._size + 1, self._size)
        self._net.train()
        squares = [self._step(order[start : start + self._size]) for start in starts]
        score = self._score(other)
        self.curve.append(host.Epoch(epoch, float(np.sqrt(np.mean(squares))), score))
        if score < self.best[0]:
            kept = {name: value.clone() for name, value in self._net.state_dict().items()}
            self.best = (score, epoch, kept)
        return score

    def _step(self, picked: Any) -> float:
        x, y, w = self._rows
        residual = self._net(x[picked]) - y[picked]
        squares = (residual**2).sum(dim=1)
        loss = (w[picked] * squares).mean()
        if self._config.l1:
            matrices = [p for p in self._net.parameters() if p.ndim > 1]
            loss = loss + self._config.l1 * sum(p.abs().sum() for p in matrices)
        self._optimiser.zero_grad()
        loss.backward()
        self._optimiser.step()
        self._plan.step()
        return float(squares.detach().mean())

    def _score(self, other: tuple[Any, Any, Any]) -> float:
        self._net.eval()
        with self._torch.no_grad():
            return float(((self._net(other[0]) - other[1]) ** 2).sum(dim=1).mean().sqrt())

    def best_net(self) -> Any:
        """The network as it was after its best epoch."""
        if self.best[2] is not None:
            self._net.load_state_dict(self.best[2])
        return self._net

    def state(self) -> dict[str, Any]:
        """All that `restore` needs."""
        return {name: part.state_dict() for name, part in self._parts.items()} | {
            "dice": self._dice.get_state(),
            "best": self.best,
            "curve": [(line.epoch, line.train_mm, line.validation_mm) for line in self.curve],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a stored state."""
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self._dice.set_state(state["dice"])
        self.best = state["best"]
        self.curve = [host.Epoch(*line) for line in state["curve"]]


def _fold(net: Any) -> list[tuple[Floats, Floats]]:
    """Dense layers alone: each batch normalisation goes into the layer after it."""
    layers: list[tuple[Floats, Floats]] = []
    scale: Floats | None = None
    shift = np.zeros(0)
    for part in net:
        kind = type(part).__name__
        if kind == "Linear":
            weight, bias = _numbers(part.weight).T, _numbers(part.bias)
            if scale is not None:
                weight, bias = weight * scale[:, None], bias + shift @ weight
            layers.append((weight, bias))
        elif kind == "BatchNorm1d":
            scale = _numbers(part.weight) / np.sqrt(_numbers(part.running_var) + part.eps)
            shift = _numbers(part.bias) - scale * _numbers(part.running_mean)
    return layers


def _numbers(tensor: Any) -> Floats:
    return np.asarray(tensor.detach().numpy(), dtype=np.float64)


@host.hookimpl
def measure_estimators() -> list[type[host.Estimator]]:
    """Register the estimator."""
    return [MlpEstimator]

"""The paper's network: 600-500-400 sigmoid units on the whole state, without a memory."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from measure.arrays import Floats
from measure.host import Dataset, Epoch, Estimator, Report, Settings, hookimpl, setting
from measure.host.onnx_estimator import Core, OnnxEstimator, Scaling
from measure.host.onnx_graph import Graph, Value
from measure_plugins.estimators._checkpoint import Checkpoint
from measure_plugins.estimators._training import torch_or_explain


class MlpSettings(Settings):
    """Settings of `mlp`; the defaults are the paper's, but for the learning rate and epochs.

    The paper states a learning rate of 1e-8. Adam moves a weight by at most about the rate at each
    step, so 10 000 epochs of 44 batches would move it by 0.004: that cannot train such a network
    (docs/learning.md shows it).
    """

    layers: tuple[int, ...] = setting((600, 500, 400), "units of the hidden layers")
    activation: Literal["sigmoid", "elu", "relu"] = setting("sigmoid", "of the hidden layers")
    learning_rate: float = setting(1e-3, "of Adam; the paper's text says 1e-8", gt=0)
    epochs: int = setting(100, "passes over the data at most", ge=1)
    patience: int = setting(20, "stop after so many epochs without a better validation", ge=1)
    batch: int = setting(1024, "rows of a batch", ge=2)
    l1: float = setting(5e-6, "L1 penalty on the weights", ge=0)
    loss: Literal["mse", "mae"] = setting("mse", "squared or absolute error")


class MlpEstimator(OnnxEstimator):
    """The paper's perceptron: three sigmoid layers with batch normalisation, L1 and Adam."""

    name = "mlp"
    Config = MlpSettings
    config: MlpSettings
    memoryless = True

    def learn(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Train with early stopping; the best epoch on the validation trajectories is kept."""
        torch = torch_or_explain()
        c = self.config
        self._scaling = Scaling.of(data.states)
        dice = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            net = _network(torch, data.states.shape[1], c)
        x, y, w = _tensors(torch, data, self._scaling)
        x_other, y_other, _ = _tensors(torch, validation, self._scaling)
        optimiser = torch.optim.Adam(net.parameters(), lr=c.learning_rate, eps=1e-8)
        plan = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, c.epochs, c.learning_rate / 50)
        saved = Checkpoint(self.checkpoint, "mlp", (seed, c.model_dump(mode="json")))
        state = saved.load() or {"epoch": 0, "curve": [], "best": (np.inf, 0, None)}
        if state["epoch"]:
            net.load_state_dict(state["net"])
            optimiser.load_state_dict(state["optimiser"])
            plan.load_state_dict(state["plan"])
            dice.set_state(state["dice"])
        curve, best = [Epoch(*line) for line in state["curve"]], state["best"]
        for epoch in range(state["epoch"], c.epochs):
            train = _epoch(torch, net, optimiser, (x, y, w), c, dice)
            plan.step()
            score = _score(torch, net, x_other, y_other)
            curve.append(Epoch(epoch, train, score))
            if score < best[0]:
                best = (score, epoch, {k: v.clone() for k, v in net.state_dict().items()})
            report((epoch + 1) / c.epochs, f"epoch {epoch + 1}: {score:.3f} mm")
            saved.store(
                epoch=epoch + 1,
                net=net.state_dict(),
                optimiser=optimiser.state_dict(),
                plan=plan.state_dict(),
                dice=dice.get_state(),
                best=best,
                curve=[(line.epoch, line.train_mm, line.validation_mm) for line in curve],
            )
            if epoch - best[1] >= c.patience:
                break
        if best[2] is not None:
            net.load_state_dict(best[2])
        self.curve = tuple(curve)
        self._layers = _fold(net)

    def compute(self, graph: Graph, features: Value, memory: Value, tick: Value) -> Core:
        """Dense layers; batch normalisation is folded into them."""
        kinds = {"sigmoid": "Sigmoid", "elu": "Elu", "relu": "Relu"}
        x = self._scaling.in_graph(graph, features)
        for index, (weight, bias) in enumerate(self._layers):
            x = graph.op("Gemm", x, weight, bias)
            if index < len(self._layers) - 1:
                x = graph.op(kinds[self.config.activation], x)
        return Core(x)


def _network(torch: Any, inputs: int, config: MlpSettings) -> Any:
    kinds = {"sigmoid": torch.nn.Sigmoid, "elu": torch.nn.ELU, "relu": torch.nn.ReLU}
    parts, width = [], inputs
    for units in config.layers:
        parts += [
            torch.nn.Linear(width, units),
            kinds[config.activation](),
            torch.nn.BatchNorm1d(units),
        ]
        width = units
    return torch.nn.Sequential(*parts, torch.nn.Linear(width, 3))


def _tensors(torch: Any, data: Dataset, scaling: Scaling) -> tuple[Any, Any, Any]:
    used = data.usable
    return tuple(
        torch.tensor(values[used], dtype=torch.float32)
        for values in (scaling.apply(data.states), data.errors_mm, data.weights())
    )


def _epoch(
    torch: Any, net: Any, optimiser: Any, rows: tuple[Any, Any, Any], config: MlpSettings, dice: Any
) -> float:
    net.train()
    x, y, w = rows
    order = torch.randperm(len(x), generator=dice)
    size = min(config.batch, len(x))
    total, count = 0.0, 0
    for start in range(0, len(x) - size + 1, size):
        picked = order[start : start + size]
        residual = net(x[picked]) - y[picked]
        squares = (residual**2).sum(dim=1)
        each = squares if config.loss == "mse" else residual.abs().sum(dim=1)
        loss = (w[picked] * each).mean()
        if config.l1:
            loss = loss + config.l1 * sum(p.abs().sum() for p in net.parameters() if p.ndim > 1)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        total, count = total + float(squares.detach().mean()), count + 1
    return float(np.sqrt(total / max(count, 1)))


def _score(torch: Any, net: Any, x: Any, y: Any) -> float:
    net.eval()
    with torch.no_grad():
        return float(((net(x) - y) ** 2).sum(dim=1).mean().sqrt())


def _fold(net: Any) -> list[tuple[Floats, Floats]]:
    """Dense layers alone: each batch normalisation goes into the layer after it."""
    layers: list[tuple[Floats, Floats]] = []
    scale: Floats | None = None
    shift = np.zeros(0)
    for part in net:
        kind = type(part).__name__
        if kind == "Linear":
            weight, bias = _array(part.weight).T, _array(part.bias)
            if scale is not None:
                weight, bias = weight * scale[:, None], bias + shift @ weight
            layers.append((weight, bias))
        elif kind == "BatchNorm1d":
            scale = _array(part.weight) / np.sqrt(_array(part.running_var) + part.eps)
            shift = _array(part.bias) - scale * _array(part.running_mean)
    return layers


def _array(tensor: Any) -> Floats:
    return np.asarray(tensor.detach().numpy(), dtype=np.float64)


@hookimpl
def measure_estimators() -> list[type[Estimator]]:
    """Register the estimator."""
    return [MlpEstimator]

"""Training the nets of `stream` in torch, by a robust loss in tip space."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import needed
from measure_learning.estimators._nets import STEP_GAIN, Grus, Perceptrons, array_of
from measure_learning.estimators._training_set import TrainingSet

_BATCH_ROWS = 512  # of a step of the perceptrons
_BATCH_WINDOWS = 32  # of a step of a GRU
AfterEpoch = Callable[[int, float, float], None]


def torch_or_explain() -> Any:
    """The torch module, on one thread; EstimatorError if it is not installed."""
    torch = needed("torch", "train", "training", EstimatorError)
    torch.set_num_threads(1)
    return torch


@dataclass(frozen=True)
class Training:
    """Options of training: epochs, learning rate, SD of input noise, weight decay, dropout."""

    epochs: int
    rate: float = 3e-3
    noise: float = 0.02
    decay: float = 0.05
    dropout: float = 0.3


def train_perceptrons(
    data: TrainingSet,
    sizes: tuple[int, ...],
    members: int,
    how: Training,
    seed: int,
    after_epoch: AfterEpoch,
) -> Perceptrons:
    """Train all members side by side on shuffled rows of inputs and bounded steps."""
    torch = torch_or_explain()
    dice = torch.Generator().manual_seed(seed)
    net = _PerceptronStack(torch, sizes, members, dice)

    def stepped(x: Any) -> Any:
        # A step larger than any learnt from must not lead the net astray.
        return torch.cat([x, _steps(x, data.moving).tanh()], dim=-1)

    inputs = torch.cat([stepped(x) for x in data.inputs.split(data.lengths.tolist())])
    offsets = data.offsets()
    rows = torch.nonzero(data.usable)[:, 0]
    batch = min(_BATCH_ROWS, len(rows))
    rounds = len(rows) // batch
    step = _Stepper(torch, [*net.parameters, offsets], how, how.epochs * rounds)
    for epoch in range(how.epochs):
        order = torch.stack(
            [rows[torch.randperm(len(rows), generator=dice)] for _ in range(members)]
        )
        total = 0.0
        for index in range(rounds):
            picked = order[:, index * batch : (index + 1) * batch]
            x = inputs[picked]
            x = x + how.noise * torch.randn(x.shape, generator=dice)
            total += step(data.loss(picked, net(x), offsets), members)
        with torch.no_grad():
            score = data.validate(lambda x: net(stepped(x).expand(members, -1, -1)).mean(dim=0))
        after_epoch(epoch, total / rounds, score)
    return Perceptrons(tuple(map(array_of, net.weights)), tuple(map(array_of, net.biases)))


def train_gru(
    data: TrainingSet,
    hidden: int,
    outputs: int,
    window: int,
    how: Training,
    seed: int,
    after_epoch: AfterEpoch,
) -> Grus:
    """Train one GRU on random windows of trajectories, sampled at random strides.

    The windows begin with a zero hidden state, so the first steps carry no loss.
    """
    torch = torch_or_explain()
    dice = np.random.default_rng(seed)
    rounds = max(1, len(data.inputs) // (_BATCH_WINDOWS * window))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = _RecurrentNet(torch, data, hidden, outputs, how.dropout)
        offsets = data.offsets()
        step = _Stepper(torch, [*net.parameters, offsets], how, how.epochs * rounds, clip=1.0)
        for epoch in range(how.epochs):
            net.drop.train()
            total = 0.0
            for picked in _windows(data, window, rounds, dice):
                x = data.inputs[picked]
                x = x + how.noise * torch.randn_like(x)
                keep = data.usable[picked].clone()
                keep[:, : min(8, window // 4)] = False
                if keep.any():
                    total += step(data.loss(picked, net(x), offsets, keep))
            net.drop.eval()
            if epoch == how.epochs - 1 or epoch % max(1, how.epochs // 20) == 0:
                with torch.no_grad():
                    score = data.validate(lambda x: net(x[None])[0])
                after_epoch(epoch, total / rounds, score)
    return pack_gru(net.gru, net.head)


class _PerceptronStack:
    """All members' layers as batched matrices, for training."""

    def __init__(self, torch: Any, sizes: tuple[int, ...], members: int, dice: Any) -> None:
        self._torch = torch
        self.weights, self.biases = [], []
        for wide, narrow in itertools.pairwise(sizes):
            start = (torch.rand(members, wide, narrow, generator=dice) * 2 - 1) / wide**0.5
            self.weights.append(start.requires_grad_())
            self.biases.append(torch.zeros(members, 1, narrow).requires_grad_())

    @property
    def parameters(self) -> list[Any]:
        """The trained tensors."""
        return [*self.weights, *self.biases]

    def __call__(self, x: Any) -> Any:
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = self._torch.baddbmm(bias, x, weight)
            if index < len(self.weights) - 1:
                x = self._torch.nn.functional.silu(x)
        return x


class _RecurrentNet:
    """A GRU on inputs and their steps, and a head on (hidden, inputs), for training."""

    def __init__(
        self, torch: Any, data: TrainingSet, hidden: int, outputs: int, dropout: float
    ) -> None:
        self._torch, self._moving = torch, data.moving
        columns = data.inputs.shape[1]
        self.gru = torch.nn.GRU(columns + len(data.moving), hidden, batch_first=True)
        self.head = torch.nn.Sequential(
            torch.nn.Linear(hidden + columns, 64), torch.nn.SiLU(), torch.nn.Linear(64, outputs)
        )
        self.drop = torch.nn.Dropout(dropout)

    @property
    def parameters(self) -> list[Any]:
        """The trained tensors."""
        return [*self.gru.parameters(), *self.head.parameters()]

    def __call__(self, x: Any) -> Any:
        hidden = self.gru(self._torch.cat([x, _steps(x, self._moving)], dim=-1))[0]
        return self.head(self._torch.cat([self.drop(hidden), x], dim=-1))


def _steps(x: Any, moving: list[int]) -> Any:
    """Differences of the moving inputs (..., rows, columns) between rows, scaled."""
    return STEP_GAIN * x[..., moving].diff(dim=-2, prepend=x[..., :1, moving])


class _Stepper:
    """AdamW on a one-cycle schedule."""

    def __init__(
        self,
        torch: Any,
        parameters: list[Any],
        how: Training,
        steps: int,
        clip: float | None = None,
    ) -> None:
        self._torch, self._parameters, self._clip = torch, parameters, clip
        self._optimiser = torch.optim.AdamW(parameters, lr=how.rate, weight_decay=how.decay)
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimiser, how.rate, total_steps=max(steps, 2) + 1, pct_start=0.1
        )

    def __call__(self, loss: Any, times: float = 1.0) -> float:
        """One step down `times` the loss; returns the loss."""
        self._optimiser.zero_grad()
        (loss * times).backward()
        if self._clip is not None:
            self._torch.nn.utils.clip_grad_norm_(self._parameters, self._clip)
        self._optimiser.step()
        self._schedule.step()
        return float(loss.detach())


def _windows(
    data: TrainingSet, window: int, rounds: int, dice: np.random.Generator
) -> Iterator[Any]:
    import torch

    chances = data.lengths / data.lengths.sum()
    for _ in range(rounds):
        runs = dice.choice(len(chances), _BATCH_WINDOWS, p=chances)
        strides = dice.choice([1, 1, 2, 3], _BATCH_WINDOWS)
        lengths = data.lengths[runs]
        first = np.floor(dice.random(_BATCH_WINDOWS) * lengths) - strides * window // 2
        rows = first[:, None] + strides[:, None] * np.arange(window)
        rows = np.clip(rows, 0, lengths[:, None] - 1) + data.starts[runs][:, None]
        yield torch.from_numpy(rows.astype(np.int64))


def pack_gru(gru: Any, head: Any) -> Grus:
    """Torch's GRU and its head as plain arrays, an ensemble of one."""
    return Grus(
        _weight(gru.weight_ih_l0),
        _weight(gru.weight_hh_l0),
        _bias(gru.bias_ih_l0),
        _bias(gru.bias_hh_l0),
        Perceptrons(
            (_weight(head[0].weight), _weight(head[2].weight)),
            (_bias(head[0].bias), _bias(head[2].bias)),
        ),
    )


def _weight(parameter: Any) -> Floats:
    return array_of(parameter).T[None]


def _bias(parameter: Any) -> Floats:
    return array_of(parameter)[None, None]

"""The two kinds of small nets of `stream`: an ensemble of perceptrons, and stateful GRUs.

Both map scaled inputs to joint errors and a direct tip error (or the latter alone), and learn by a
robust loss in tip space. Training is torch; the trained weights are plain arrays.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import EstimatorError
from measure.host.onnx_graph import Graph, Value


def torch_or_explain() -> Any:
    """The torch module, on one thread.

    Raises:
        EstimatorError: it is not installed.
    """
    try:
        import torch
    except ImportError:
        raise EstimatorError(
            "training needs the extra 'train': pip install 'triball[train]'"
        ) from None
    torch.set_num_threads(1)
    return torch


GAIN = 3.0  # brings differences between steps to the size of the other inputs


@dataclass(frozen=True, eq=False)
class Lesson:
    """What nets learn from.

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
class Perceptrons:
    """Members of an ensemble: weights (members, in, out) and biases (members, 1, out) by layer."""

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]

    def in_graph(self, graph: Graph, inputs: Value) -> Value:
        """(members, N, outputs)."""
        x = inputs
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = graph.affine(x, weight, bias)
            if index < len(self.weights) - 1:
                x = graph.op("Mul", x, graph.op("Sigmoid", x))
        return x


@dataclass(frozen=True, eq=False)
class Grus:
    """Members of an ensemble of one-layer GRUs with a two-layer head on (hidden, inputs).

    Gates in torch's order: reset, update, new. Arrays have the members first.
    """

    from_input: Floats
    from_hidden: Floats
    input_bias: Floats
    hidden_bias: Floats
    head: Perceptrons

    @property
    def members(self) -> int:
        """Number of nets."""
        return int(self.from_hidden.shape[0])

    @property
    def hidden(self) -> int:
        """Hidden units of each."""
        return int(self.from_hidden.shape[1])

    def in_graph(
        self, graph: Graph, inputs: Value, steps: Value, memory: Value
    ) -> tuple[Value, Value]:
        """Outputs (members, N, outputs) and new memory (N, members x hidden).

        `steps` are the differences of the moving inputs since the memory was last kept.
        """
        seen = graph.op("Concat", inputs, graph.op("Mul", steps, np.float32(GAIN)), axis=1)
        h = graph.op(
            "Transpose", graph.reshape(memory, -1, self.members, self.hidden), perm=[1, 0, 2]
        )
        given = graph.ops("Split", 3, graph.affine(seen, self.from_input, self.input_bias), axis=2)
        kept = graph.ops("Split", 3, graph.affine(h, self.from_hidden, self.hidden_bias), axis=2)
        reset = graph.op("Sigmoid", graph.op("Add", given[0], kept[0]))
        update = graph.op("Sigmoid", graph.op("Add", given[1], kept[1]))
        fresh = graph.op("Tanh", graph.op("Add", given[2], graph.op("Mul", reset, kept[2])))
        h = graph.mix(update, h, fresh)
        spread = graph.op("Add", inputs, np.zeros((self.members, 1, 1)))
        out = self.head.in_graph(graph, graph.op("Concat", h, spread, axis=2))
        after = graph.op("Transpose", h, perm=[1, 0, 2])
        return out, graph.reshape(after, -1, self.members * self.hidden)


@dataclass(frozen=True)
class Training:
    """How nets are trained: passes over the data, noise on inputs, weight decay, drop-out."""

    epochs: int
    rate: float = 3e-3
    noise: float = 0.02
    decay: float = 0.05
    dropout: float = 0.3


def train_perceptrons(
    lesson: Lesson,
    sizes: tuple[int, ...],
    members: int,
    how: Training,
    seed: int,
    after_epoch: Callable[[int, float, float], None],
) -> Perceptrons:
    """Train all members side by side on shuffled rows."""
    torch = torch_or_explain()
    dice = torch.Generator().manual_seed(seed)
    weights, biases = [], []
    for wide, narrow in itertools.pairwise(sizes):
        start = (torch.rand(members, wide, narrow, generator=dice) * 2 - 1) / wide**0.5
        weights.append(start.requires_grad_())
        biases.append(torch.zeros(members, 1, narrow).requires_grad_())

    def forward(x: Any) -> Any:
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if index < len(weights) - 1:
                x = torch.nn.functional.silu(x)
        return x

    rows = torch.nonzero(lesson.usable)[:, 0]
    batch = min(512, len(rows))
    rounds = len(rows) // batch
    optimiser, schedule = _optimiser(torch, [*weights, *biases], how, how.epochs * rounds)
    for epoch in range(how.epochs):
        order = torch.stack(
            [rows[torch.randperm(len(rows), generator=dice)] for _ in range(members)]
        )
        total = 0.0
        for index in range(rounds):
            picked = order[:, index * batch : (index + 1) * batch]
            x = lesson.inputs[picked]
            x = x + how.noise * torch.randn(x.shape, generator=dice)
            loss = lesson.loss(picked, forward(x), None)
            optimiser.zero_grad()
            (loss * members).backward()
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        with torch.no_grad():
            score = lesson.validate(lambda x: forward(x.expand(members, -1, -1)).mean(dim=0))
        after_epoch(epoch, total / rounds, score)
    return Perceptrons(tuple(map(_array, weights)), tuple(map(_array, biases)))


def train_gru(
    lesson: Lesson,
    hidden: int,
    outputs: int,
    window: int,
    how: Training,
    seed: int,
    after_epoch: Callable[[int, float, float], None],
) -> Grus:
    """Train one GRU on random windows of trajectories, sampled at random strides.

    The windows begin from a forgotten state, so the first steps carry no loss.
    """
    torch = torch_or_explain()
    dice = np.random.default_rng(seed)
    columns = lesson.inputs.shape[1]
    seen = columns + len(lesson.moving)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        gru = torch.nn.GRU(seen, hidden, batch_first=True)
        head = torch.nn.Sequential(
            torch.nn.Linear(hidden + columns, 64), torch.nn.SiLU(), torch.nn.Linear(64, outputs)
        )
        drop = torch.nn.Dropout(how.dropout)

        def forward(x: Any) -> Any:
            steps = torch.diff(x[..., lesson.moving], dim=1, prepend=x[:, :1, lesson.moving])
            return head(torch.cat([drop(gru(torch.cat([x, GAIN * steps], -1))[0]), x], dim=-1))

        rounds = max(1, len(lesson.inputs) // (32 * window))
        parameters = [*gru.parameters(), *head.parameters()]
        optimiser, schedule = _optimiser(torch, parameters, how, how.epochs * rounds)
        for epoch in range(how.epochs):
            drop.train()
            total = 0.0
            for picked in _windows(lesson, window, rounds, dice):
                x = lesson.inputs[picked]
                x = x + how.noise * torch.randn_like(x)
                keep = lesson.usable[picked].clone()
                keep[:, : min(8, window // 4)] = False
                if not keep.any():
                    continue
                loss = lesson.loss(picked, forward(x), keep)
                optimiser.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(parameters, 1.0)
                optimiser.step()
                schedule.step()
                total += float(loss.detach())
            drop.eval()
            last = epoch == how.epochs - 1
            if last or epoch % max(1, how.epochs // 20) == 0:
                with torch.no_grad():
                    after_epoch(
                        epoch, total / rounds, lesson.validate(lambda x: forward(x[None])[0])
                    )
    return _pack_gru(gru, head)


def stack_grus(nets: list[Grus]) -> Grus:
    """Several trained GRUs as one ensemble."""
    layers = range(len(nets[0].head.weights))

    def joined(name: str) -> Floats:
        return np.concatenate([getattr(net, name) for net in nets])

    return Grus(
        from_input=joined("from_input"),
        from_hidden=joined("from_hidden"),
        input_bias=joined("input_bias"),
        hidden_bias=joined("hidden_bias"),
        head=Perceptrons(
            tuple(np.concatenate([net.head.weights[i] for net in nets]) for i in layers),
            tuple(np.concatenate([net.head.biases[i] for net in nets]) for i in layers),
        ),
    )


def _optimiser(torch: Any, parameters: list[Any], how: Training, steps: int) -> tuple[Any, Any]:
    optimiser = torch.optim.AdamW(parameters, lr=how.rate, weight_decay=how.decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, how.rate, total_steps=max(steps, 2) + 1, pct_start=0.1
    )
    return optimiser, schedule


def _windows(lesson: Lesson, window: int, rounds: int, dice: np.random.Generator) -> Iterator[Any]:
    import torch

    chances = lesson.lengths / lesson.lengths.sum()
    for _ in range(rounds):
        runs = dice.choice(len(chances), 32, p=chances)
        strides = dice.choice([1, 1, 2, 3], 32)
        lengths = lesson.lengths[runs]
        first = np.floor(dice.random(32) * lengths) - strides * window // 2
        rows = first[:, None] + strides[:, None] * np.arange(window)
        rows = np.clip(rows, 0, lengths[:, None] - 1) + lesson.starts[runs][:, None]
        yield torch.from_numpy(rows.astype(np.int64))


def _pack_gru(gru: Any, head: Any) -> Grus:
    def weight(parameter: Any) -> Floats:
        return _array(parameter).T[None]

    def bias(parameter: Any) -> Floats:
        return _array(parameter)[None, None]

    return Grus(
        weight(gru.weight_ih_l0),
        weight(gru.weight_hh_l0),
        bias(gru.bias_ih_l0),
        bias(gru.bias_hh_l0),
        Perceptrons(
            (weight(head[0].weight), weight(head[2].weight)),
            (bias(head[0].bias), bias(head[2].bias)),
        ),
    )


def _array(tensor: Any) -> Floats:
    return np.asarray(tensor.detach().numpy(), dtype=np.float64)

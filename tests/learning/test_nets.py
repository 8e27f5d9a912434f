"""The graphs compute what the nets they come from compute."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from measure.host import Dataset
from measure.host.interfaces import quiet
from measure.robots import SerialChain
from measure_learning.core import Split
from measure_learning.estimators import _nets, _training
from measure_learning.estimators._play import PlayBank
from measure_learning.estimators.stream import StreamEstimator, StreamSettings
from measure_learning.onnx import Graph
from measure_learning.onnx.kinematics import TorchTip, tip_change
from measure_learning.onnx.rotation import LEVER_MM, TurnChain, turn_errors
from measure_learning.robots import find_schema
from measure_paper import mlp

torch = pytest.importorskip("torch", reason="training needs the extra 'train'")


def _run(graph: Graph, inputs: dict[str, Any], outputs: dict[str, tuple[str, int]]) -> list[Any]:
    import onnxruntime as ort

    content = graph.build(
        {name: value.shape[1] for name, value in inputs.items()},
        {name: (value, (width,)) for name, (value, width) in outputs.items()},
        {},
    )
    session = ort.InferenceSession(content, providers=["CPUExecutionProvider"])
    return list(session.run(None, {k: v.astype(np.float32) for k, v in inputs.items()}))


def test_gru_steps_equal_torchs_sequence() -> None:
    torch.manual_seed(1)
    members = []
    nets = []
    for _ in range(2):
        gru = torch.nn.GRU(5, 7, batch_first=True)
        head = torch.nn.Sequential(
            torch.nn.Linear(7 + 4, 6), torch.nn.SiLU(), torch.nn.Linear(6, 3)
        )
        nets.append((gru, head))
        members.append(_training.pack_gru(gru, head))
    stacked = _nets.stack_grus(members)
    x = torch.randn(2, 9, 4)
    steps = torch.randn(2, 9, 1)
    with torch.no_grad():
        wanted = [
            head(torch.cat([gru(torch.cat([x, _nets.STEP_GAIN * steps], -1))[0], x], dim=-1))
            for gru, head in nets
        ]
    memory = np.zeros((2, 14))
    for index in range(9):
        graph = Graph()
        out, after = stacked.in_graph(graph, "x", "steps", "memory")
        flat = graph.reshape(graph.op("Transpose", out, perm=[1, 0, 2]), -1, 6)
        got, memory = _run(
            graph,
            {
                "x": x[:, index].numpy(),
                "steps": _nets.STEP_GAIN * steps[:, index].numpy(),
                "memory": memory,
            },
            {"out": (flat, 6), "memory_out": (after, 14)},
        )
        both = np.concatenate([w[:, index].numpy() for w in wanted], axis=1)
        np.testing.assert_allclose(got, both, atol=1e-6)


def test_batch_normalisation_folds_into_dense_layers() -> None:
    torch.manual_seed(2)
    net = mlp._network(torch, 6, mlp.MlpSettings(layers=(8, 5)))
    net.train()
    for _ in range(20):
        net(torch.randn(64, 6) * 3 + 1)
    net.eval()
    x = torch.randn(10, 6)
    values = x.numpy().astype(np.float64)
    layers = mlp._fold(net)
    for index, (weight, bias) in enumerate(layers):
        values = values @ weight + bias
        if index < len(layers) - 1:
            values = 1.0 / (1.0 + np.exp(-values))
    with torch.no_grad():
        np.testing.assert_allclose(values, net(x).numpy(), atol=1e-5)


@pytest.mark.parametrize("kind", [SerialChain, TurnChain])
def test_kinematics_in_torch_and_onnx(kind: type[SerialChain]) -> None:
    """Places, and rotation vectors times the lever, also large ones."""
    schema, rng = find_schema("dvrk-psm"), np.random.default_rng(3)
    chain, turns = kind(schema.chain.joints, schema.chain.tool), kind is TurnChain
    states = rng.uniform(-0.6, 0.6, (20, 9))
    states[:, 2] = rng.uniform(0.05, 0.2, 20)
    change = rng.normal(0, 0.15 if turns else 0.05, (20, 6)) * np.array([1, 1, 20, 1, 1, 1])
    q = schema.joint_positions(states)
    wanted = chain.tip_mm(q + change) - chain.tip_mm(q)
    if turns:
        wanted = LEVER_MM * turn_errors(chain.pose(q + change).rotation, chain.pose(q).rotation)
        assert np.linalg.norm(wanted, axis=1).max() > 0.5 * LEVER_MM
    graph = Graph()
    out = tip_change(graph, replace(schema, chain=chain), "features", "dq")
    (got,) = _run(graph, {"features": states, "dq": change}, {"out": (out, 3)})
    np.testing.assert_allclose(got, wanted, atol=2e-4, rtol=0.01 if turns else 1e-7)
    tip = TorchTip(chain)
    now, before = (tip(torch.tensor(one, dtype=torch.float32)) for one in (q + change, q))
    np.testing.assert_allclose(tip.change(now, before).numpy(), got, atol=5e-4)


def test_play_operators_in_the_graph(small: Dataset) -> None:
    bank = PlayBank.of(small, 3, 0.01, 0.2, halves=True)
    wanted = bank.features(small)
    assert bank.size == 72  # six joints and eighteen combinations of the wrist's, three widths
    assert np.abs(wanted).max() <= 1.0 + 1e-9
    memory = np.zeros((1, 1 + bank.size))
    for row in range(30):
        graph = Graph()
        sizes = graph.constant([1, bank.size], np.int64)
        started, states = graph.ops("Split", 2, "memory", sizes, axis=1)
        play, after = bank.in_graph(graph, "features", states, started)
        begun = graph.op("Add", graph.op("Mul", started, np.float32(0.0)), np.float32(1.0))
        kept = graph.op("Concat", begun, after, axis=1)
        got, memory = _run(
            graph,
            {"features": small.states[row : row + 1], "memory": memory},
            {"play": (play, bank.size), "memory_out": (kept, 1 + bank.size)},
        )
        np.testing.assert_allclose(got[0], wanted[row], atol=5e-3)


def test_play_is_a_hysteresis_loop(small: Dataset) -> None:
    """Up and down again over more than the play leaves the two branches two widths apart."""
    from measure_learning.estimators._play_kernel import play

    path = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, -1, 100), np.linspace(-1, 0, 50)])
    inside = play(path[:, None], np.array([[0.2]]))[:, 0] * 0.2
    down, up = inside[100], inside[-1]
    assert down == pytest.approx(-0.2)
    assert up == pytest.approx(0.2)
    assert play(path[:, None] * 0.1, np.array([[0.2]]))[:, 0] * 0.2 == pytest.approx(path * 0.1)


def test_the_graph_answers_what_training_scored(split: Split) -> None:
    """The perceptrons of `stream` see the same steps in a file, state by state, as in training."""
    fit = StreamEstimator(
        StreamSettings(
            perceptrons=1, perceptron_units=16, perceptron_epochs=3, grus=1, gru_units=4,
            gru_epochs=1, window=16, play_widths=2, points=0,
        )
    )  # fmt: skip
    fit.folds = 0
    fit.fit(split.train, split.validation, seed=0, report=quiet)
    *first, last = fit._perceptrons.weights
    biases = fit._perceptrons.biases
    fit._perceptrons = _nets.Perceptrons((*first, 2 * last), (*biases[:-1], 2 * biases[-1]))
    head = fit._grus.head  # silent, so that the mean of both is the perceptron
    silent = _nets.Perceptrons(*(tuple(map(np.zeros_like, p)) for p in (head.weights, head.biases)))
    fit._grus = replace(fit._grus, head=silent)
    left = split.validation.errors_mm - fit.model.predict(split.validation).errors_mm
    rms = float(np.sqrt((left[split.validation.usable] ** 2).sum(axis=1).mean()))
    assert rms == pytest.approx(fit.curve[2].validation_mm, rel=1e-4)

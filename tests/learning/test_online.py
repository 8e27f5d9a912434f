"""Refusals, packets, the UDP server, re-zeroing and drift."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.online import time_round_trips
from measure.errors import EstimatorError
from measure.host import Correction, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import (
    AnswerPacket,
    EstimateClient,
    EstimateServer,
    GuardedModel,
    Refusal,
    Split,
    StatePacket,
    correct_file,
    read_states,
)
from measure_learning.onnx import OnnxModel
from measure_learning.robots import tables
from measure_learning.robots.tables import Table
from tests.learning.conftest import serving

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")


@pytest.fixture(scope="module")
def model_path(split: Split, tmp_path_factory: pytest.TempPathFactory) -> Path:
    estimator = Registry.discover().build(Estimator, "ridge", {"play_widths": 3})
    estimator.fit(split.train, split.validation, seed=0, report=quiet)
    path = tmp_path_factory.mktemp("model") / "ridge.onnx"
    estimator.save(path, {})
    return path


@pytest.fixture
def guarded(model_path: Path) -> GuardedModel:
    return GuardedModel(OnnxModel.load(model_path))


def test_a_program_that_was_started_again_begins_anew(guarded: GuardedModel, split: Split) -> None:
    states = split.test.states
    first = [guarded.update(states[i], 100.0 + i, i) for i in range(5)]
    assert guarded.update(states[0], 0.0, 3) is Refusal.REPEATED
    again = [guarded.update(states[i], float(i), i) for i in range(5)]
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.error_mm, b.error_mm)
    assert guarded.counters.lost == 0


@pytest.mark.parametrize("stray", [2**60, 3_000_000])
def test_a_wild_sequence_number_blocks_no_others(
    guarded: GuardedModel, split: Split, stray: int
) -> None:
    """It used to refuse all that followed, and to count a quintillion as lost."""
    states = split.test.states
    for i in range(5):
        assert isinstance(guarded.update(states[i], float(i), 1000 + i), Correction)
    assert guarded.update(states[5], 5.0, stray) is Refusal.REPEATED
    assert isinstance(guarded.update(states[5], 5.0, 1005), Correction)
    assert guarded.counters.lost == 0


def test_a_program_that_counts_from_elsewhere_is_heard_again(
    guarded: GuardedModel, split: Split
) -> None:
    states = split.test.states
    assert isinstance(guarded.update(states[0], 100.0, 2**60), Correction)
    assert guarded.update(states[0], 0.0, 7) is Refusal.REPEATED
    again = [guarded.update(states[i], float(i), 7 + i) for i in range(1, 4)]
    fresh = guarded.model.another()
    for i, answer in enumerate(again, 1):
        np.testing.assert_array_equal(answer.error_mm, fresh.update(states[i], float(i)).error_mm)


def test_one_odd_stamp_silences_nobody(
    server: EstimateServer, model_path: Path, split: Split
) -> None:
    """A huge one used to refuse all that followed, for ever."""
    states, good = split.test.states, np.arange(0.0, 10.0, 0.5)
    alone = OnnxModel.load(model_path)
    wanted = [alone.update(states[i], time_s) for i, time_s in enumerate(good)][-1]
    for odd_s in (1e300, 1e9, -1e300, -60.0, 905.0, 35.0):
        client = EstimateClient(server.address, timeout_s=20.0)
        answers = [client.ask(states[i], time_s) for i, time_s in enumerate(good[:10])]
        answers.append(client.ask(states[10], odd_s))
        answers += [client.ask(states[i], good[i]) for i in range(10, 20)]
        client.close()
        assert sum(a is None or isinstance(a.answer, Refusal) for a in answers) == 1
        last = answers[-1]
        if not 5.0 < odd_s < 1000.0:  # as if it had never come; a pause is believed
            np.testing.assert_allclose(last.answer.error_mm, wanted.error_mm, atol=1e-4)


def test_a_first_stamp_that_is_odd_silences_nobody(guarded: GuardedModel, split: Split) -> None:
    state = split.test.states[0]
    assert guarded.update(state, np.inf, 0) is Refusal.NOT_A_NUMBER
    assert isinstance(guarded.update(state, 1e300, 0), Correction)
    answers = [guarded.update(state, 0.1 * i, i) for i in range(1, 5)]
    assert [isinstance(answer, Correction) for answer in answers] == [False, True, True, True]


def test_a_clock_that_was_set_begins_anew(guarded: GuardedModel, split: Split) -> None:
    """Two odd stamps that do not follow each other are no clock."""
    states = split.test.states
    for start in (0.0, 1e6, 500.0):
        answers = [guarded.update(states[i], start + i) for i in range(4)]
        assert [isinstance(a, Refusal) for a in answers] == [start > 0, False, False, False]
    fresh = guarded.model.another()
    wanted = [fresh.update(states[i], 500.0 + i) for i in range(1, 4)][-1]
    assert isinstance(answers[-1], Correction)
    np.testing.assert_array_equal(answers[-1].error_mm, wanted.error_mm)
    assert guarded.update(states[0], 1e300) is Refusal.LEAP
    assert guarded.update(states[0], 1e200) is Refusal.LEAP
    assert guarded.update(states[0], 1.0) is Refusal.STALE
    assert isinstance(guarded.update(states[0], 504.0), Correction)


def test_a_refused_state_leaves_no_trace(guarded: GuardedModel, split: Split) -> None:
    states = split.test.states
    first = [guarded.update(states[i], float(i)) for i in range(5)]
    guarded.reset()
    second = []
    for i in range(5):
        second.append(guarded.update(states[i], float(i)))
        guarded.update(states[i + 20] * np.nan, i + 0.5)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.error_mm, b.error_mm)


def test_packets() -> None:
    state = StatePacket(2**40, 12.25, np.arange(118.0))
    again = StatePacket.unpack(state.pack())
    assert (again.sequence, again.time_s) == (2**40, 12.25)
    np.testing.assert_array_equal(again.state, state.state)
    assert StatePacket.unpack(state.pack()[:-1]) is None
    assert StatePacket.unpack(b"hello") is None
    covariance = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 4.0]])
    answer = AnswerPacket(3, 1.0, Correction(np.array([1.0, -2.0, 3.0]), covariance, True))
    back = AnswerPacket.unpack(answer.pack()).answer
    assert back.unfamiliar
    np.testing.assert_allclose(back.covariance, covariance, rtol=1e-6)
    for reason in Refusal:
        assert AnswerPacket.unpack(AnswerPacket(1, 0.0, reason).pack()).answer is reason
    with pytest.raises(EstimatorError, match="not an estimator's"):
        AnswerPacket.unpack(b"hello")


@pytest.fixture
def server(model_path: Path) -> Iterator[EstimateServer]:
    with serving(EstimateServer(OnnxModel.load(model_path), ("127.0.0.1", 0))) as server:
        yield server


def test_answers_over_udp(server: EstimateServer, model_path: Path, split: Split) -> None:
    client = EstimateClient(server.address, timeout_s=20.0)
    model = OnnxModel.load(model_path)
    for row in range(30):
        packet = client.ask(split.test.states[row], float(split.test.times_s[row]))
        wanted = model.update(split.test.states[row], float(split.test.times_s[row]))
        np.testing.assert_allclose(packet.answer.error_mm, wanted.error_mm, atol=1e-4)
    client.send(b"garbage")
    answer = client.receive()
    assert answer.answer is Refusal.MALFORMED
    nan_stamp = client.ask(split.test.states[0], float("nan"))
    assert nan_stamp.answer is Refusal.NOT_A_NUMBER
    client.close()
    assert server.counters.corrected == 30
    assert server.latency_us()["p50_us"] > 0


def test_an_answer_that_cannot_be_sent_ends_nothing(model_path: Path) -> None:
    server = EstimateServer(OnnxModel.load(model_path), ("127.0.0.1", 0))
    server._respond(b"garbage", ("127.0.0.1", 0))
    assert server.counters.values()["unsent"] == 1
    server.close()


def test_a_late_answer_is_not_taken_for_that_to_the_next_state() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as slow:
        slow.bind(("127.0.0.1", 0))
        client = EstimateClient(slow.getsockname(), timeout_s=0.05)
        assert client.ask(np.zeros(3), 0.0) is None
        _, sender = slow.recvfrom(1000)
        slow.sendto(AnswerPacket(0, 0.0, Refusal.NOT_A_NUMBER).pack(), sender)
        assert client.ask(np.zeros(3), 1.0) is None
        slow.sendto(AnswerPacket(1, 1.0, Refusal.NOT_A_NUMBER).pack(), sender)
        slow.sendto(AnswerPacket(2, 2.0, Refusal.STALE).pack(), sender)
        answer = client.ask(np.zeros(3), 2.0)
        client.close()
    assert answer.answer is Refusal.STALE


def test_a_hundred_hertz_lose_nothing(server: EstimateServer, split: Split) -> None:
    client = EstimateClient(server.address)
    result = time_round_trips(client, split.test.states[:50], 1.0, rate_hz=100.0)
    client.close()
    assert result.answered == result.sent == 100
    assert server.counters.lost == 0


def test_offline_is_online(
    model_path: Path, split: Split, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    data = split.test
    path = tmp_path / "states.parquet"
    columns = {name: data.states[:, i] for i, name in enumerate(data.schema.names)}
    labels = {
        "run": np.array(data.names)[data.trajectory],
        "i": np.arange(len(data)),
        "t_s": data.times_s,
    }
    parquet.write_table(pa.table(labels | columns), path)
    model = OnnxModel.load(model_path)
    estimates = model.predict(data)
    monkeypatch.setattr(tables, "PIECE_ROWS", len(data) // 3)
    for name in ("errors.parquet", "errors.csv"):
        assert correct_file(path, model, tmp_path / name)["corrected"] == len(data)
        written = Table.read(tmp_path / name)
        assert written.labels("run") == labels["run"].tolist()
        np.testing.assert_array_equal(written.numbers("t_s")[:, 0], data.times_s)
        errors = written.numbers("ex", "ey", "ez")
        np.testing.assert_allclose(errors, estimates.errors_mm, atol=1e-4)
        places = written.numbers("x_mm", "y_mm", "z_mm")
        np.testing.assert_allclose(places, data.reported_mm + errors, atol=1e-3)
        each = written.numbers("x_sd_mm", "y_sd_mm", "z_sd_mm")
        wanted = np.sqrt(np.diagonal(estimates.covariances, axis1=1, axis2=2))
        np.testing.assert_allclose(each, wanted, rtol=1e-3)
        np.testing.assert_allclose(written.numbers("sd_mm")[:, 0], np.linalg.norm(each, axis=1))
        names = ("xx", "xy", "xz", "yy", "yz", "zz")
        upper = written.numbers(*(f"cov_{pair}_mm2" for pair in names))
        whole = upper[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        np.testing.assert_allclose(whole, estimates.covariances, rtol=1e-3, atol=1e-6)
        assert np.abs(upper[:, [1, 2, 4]]).max() > 1e-3  # axes are not independent
    columns.pop("tau_0")
    parquet.write_table(pa.table(labels | columns), path)
    with pytest.raises(EstimatorError, match="lacks 1 of 118 columns: tau_0"):
        read_states(path, model)
    np.testing.assert_allclose(model.schema.position_mm(data.states), data.reported_mm, atol=1e-9)

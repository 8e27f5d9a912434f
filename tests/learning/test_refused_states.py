"""States over UDP that cannot be corrected are refused, counted and told, as typed."""

from __future__ import annotations

import json
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from measure.arrays import Floats
from measure.cli import main
from measure.host import Correction, Dataset
from measure_learning.core import AnswerPacket, EstimateClient, Refusal, StatePacket

pytest.importorskip("onnx", reason="fitting needs the extra 'train'")


def test_live_states_that_cannot_be_corrected(
    folder: Path, small: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wrong count, NaN, stale stamp, reordering, garbage: each answered with its reason."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["estimate", str(folder / "model.onnx"), "--port", str(port), "--seconds", "4"]
    capsys.readouterr()
    server = threading.Thread(target=main, args=([*words, "--json"],))
    server.start()
    client = _client(port, small.states[0])
    state = small.states[0]
    broken = np.where(np.arange(len(state)) == 7, np.nan, state)
    sent: list[tuple[int, float, Floats, Refusal | None]] = [
        (5, 1.0, state, None),
        (7, 1.2, state, None),  # 6 is lost
        (6, 1.3, state, Refusal.REPEATED),
        (8, 1.2, state, Refusal.STALE),
        (8, 1.3, state[:-1], Refusal.FEATURE_COUNT),
        (8, 1.3, broken, Refusal.NOT_A_NUMBER),
        (8, 1.3, state, None),
    ]
    for sequence, time_s, values, wanted in sent:
        answer = _asked(client, StatePacket(sequence, time_s, values).pack())
        assert answer.sequence == sequence
        if wanted is None:
            assert isinstance(answer.answer, Correction)
        else:
            assert answer.answer is wanted
    assert _asked(client, b"garbage").answer is Refusal.MALFORMED
    client.close()
    server.join()
    counts = json.loads(capsys.readouterr().out)
    assert counts["lost"] == 5  # 1 to 4 and 6
    refused = {wanted for *_, wanted in sent if wanted} | {Refusal.MALFORMED}
    assert {reason: counts[reason] for reason in Refusal} == {r: r in refused for r in Refusal}


def _client(port: int, state: Floats) -> EstimateClient:
    """Connected, once the server answers."""
    client = EstimateClient(("127.0.0.1", port), timeout_s=5.0)
    for _ in range(200):
        client.send(StatePacket(0, 0.0, state).pack())
        if client.receive() is not None:
            return client
        time.sleep(0.02)
    raise AssertionError("the server does not answer")


def _asked(client: EstimateClient, data: bytes) -> AnswerPacket:
    client.send(data)
    answer = client.receive()
    assert answer is not None
    return answer

"""Hostile senders change no number of the robot's, and leave its states' answers alone."""

from __future__ import annotations

import socket

import numpy as np
import pytest

from benchmarks.faults.packets import KINDS, difference_mm, flood_of
from measure.host import Correction
from measure_learning.api import shipped_model
from measure_learning.core import AnswerPacket, EstimateClient, EstimateServer, StatePacket
from measure_learning.core.server import MOST_SENDERS, Lanes
from measure_learning.onnx import OnnxModel
from measure_learning.simulator import simulate


def test_no_datagram_of_others_moves_a_correction():
    worst, answers = difference_mm(4000, seed=36)
    assert worst < 1e-6
    assert set(answers) == {
        "malformed packet",
        "a feature is not a number",
        "wrong number of features",
        "sequence number repeated or out of order",
        "stamp not after the last one",
        "too many senders",
        "corrected",
    }


def test_a_flood_leaves_room_for_the_robot(monkeypatch):
    """Its states wait in a queue of their own, and come before all that came earlier."""
    monkeypatch.setattr("measure_learning.core.server._BUFFER_BYTES", 1 << 14)
    server = EstimateServer(OnnxModel.load(shipped_model()), ("127.0.0.1", 0))
    robot = EstimateClient(server.address, timeout_s=10.0)
    states = simulate(1.0, 5).states
    robot.send(StatePacket(0, 0.0, states[0]).pack())
    server.serve(0.5)
    assert isinstance(robot.receive().answer, Correction)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.connect(server.address)
        for data in flood_of("22 bytes, no feature") * 10:  # more than there is room for
            stranger.send(data)
        for turn in range(1, 5):
            robot.send(StatePacket(turn, 1e-3 * turn, states[turn]).pack())
        heard = list(server._lanes.receive(0.0))
        assert StatePacket.unpack(heard[0][0]).sequence == 1
        assert len(heard) > 2  # the others are heard too, after it
        server.serve(0.5)
    server.close()
    robot.close()
    assert server.counters.lost == 1  # the one that was looked at above
    assert server.counters.corrected == 4


def test_refusals_to_strangers_are_few():
    server = EstimateServer(OnnxModel.load(shipped_model()), ("127.0.0.1", 0), clock=lambda: 1.5)
    for _ in range(1200):
        server._respond(b"noise", ("127.0.0.1", 9))
    assert server.counters.unanswered == 200
    server.close()


def test_a_lane_is_its_senders_alone():
    """And nobody else can listen at the address meanwhile."""
    lanes = Lanes(("127.0.0.1", 0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.sendto(b"first", lanes.address)
        lanes.open(one.getsockname())
        one.sendto(b"second", lanes.address)
        heard = [data for _ in range(3) for data, _ in lanes.receive(0.1)]
        assert heard == [b"first", b"second"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
        thief.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with pytest.raises(OSError, match="in use"):
            thief.bind(lanes.address)
    lanes.close()


def test_whole_states_from_everywhere_are_too_many():
    """The first senders keep their places."""
    server = EstimateServer(OnnxModel.load(shipped_model()), ("127.0.0.1", 0))
    states = simulate(1.0, 5).states
    answers = [
        AnswerPacket.unpack(
            server.answer(StatePacket(0, 0.0, states[0]).pack(), ("127.0.0.1", 50_000 + k))
        ).answer
        for k in range(MOST_SENDERS + 3)
    ]
    assert sum(isinstance(one, Correction) for one in answers) == MOST_SENDERS
    assert answers[-1] == "too many senders"
    server.close()


def test_every_kind_is_a_kind():
    states = simulate(1.0, 5).states
    for name in KINDS:
        whole = [StatePacket.unpack(data) for data in flood_of(name)]
        good = [one for one in whole if one is not None and len(one.state) == states.shape[1]]
        finite = [one for one in good if np.isfinite([*one.state, one.time_s]).all()]
        assert bool(finite) == (name == "a whole state")

"""Asking for real time, and a benchmark whose sender is late."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from benchmarks import online
from measure_learning import api
from measure_learning.core import server
from measure_learning.simulator import simulate


def test_real_time_is_had_or_refused_in_one_line() -> None:
    """In a process of its own: what it asks for stays."""
    words = "import os; from measure_learning.core.server import claim_realtime as claim; "
    words += "print(claim()); print(os.sched_getscheduler(0) == os.SCHED_FIFO)"
    done = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True, timeout=120
    )
    refused, fifo = done.stdout.splitlines()
    assert fifo == str("priority" not in refused)
    assert not refused or refused.startswith("not in real time: the system refuses ")


def test_missing_rights_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    class Libc:
        def __init__(self, *_: object, **__: object) -> None: ...

        def mlockall(self, _: int) -> int:
            return -1

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(server.ctypes, "CDLL", Libc)
    line = server.claim_realtime()
    assert "refuses priority (Operation not permitted) and locked memory (" in line
    assert "rtprio 10 and memlock unlimited" in line


def test_a_late_sender_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server used to end three seconds after the last state was due."""
    in_time = online.time_round_trips

    def late(client: Any, states: Any, seconds: float) -> Any:
        client.ask(states[0], 1e-4)
        online.time.sleep(seconds + 3.5)
        return in_time(client, states, seconds)

    monkeypatch.setattr(online, "time_round_trips", late)
    states = np.ascontiguousarray(simulate(1.0, 5, log_hz=100.0).states)
    first, *_ = online.round_trip_lines(api.shipped_model(), states, 0.1)
    assert ": 100 sent, 100 answered, 101 corrected, 0 lost" in first

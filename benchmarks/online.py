"""Correcting online: `python -m benchmarks.online [MODEL] [--seconds 60]`.

First one update in this process, from the received packet to the packet that goes back: median and
99th percentile by the clock, and the best of ten blocks' medians, which other work on the machine
disturbs least. Then `measure estimate` in a process of its own, which is sent a simulated robot's
states by UDP at 1 kHz, one at a time: round trips, what was lost, and the load of a core.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import run_command
from measure.arrays import Floats
from measure.host import Correction
from measure_learning import api
from measure_learning.core import EstimateClient, EstimateServer, StatePacket
from measure_learning.core.server import claim_realtime
from measure_learning.onnx import OnnxModel
from measure_learning.simulator import simulate

BLOCKS, BLOCK = 10, 1000


@dataclass(frozen=True)
class RoundTrips:
    """Round trips of states to the estimator and back.

    Attributes:
        sent: states sent.
        answered: answers received.
        corrected: of these, corrections.
        late: ticks that began over a millisecond late: this machine was busy, or an answer slow.
        p50_us: median round trip.
        p99_us: 99th percentile.
        rate_hz: states per second.
        client_load: share of a core this client used, waiting included.
    """

    sent: int
    answered: int
    corrected: int
    late: int
    p50_us: float
    p99_us: float
    rate_hz: float
    client_load: float


def time_round_trips(
    client: EstimateClient, states: Floats, seconds: float, rate_hz: float = 1000.0
) -> RoundTrips:
    """Send states at a fixed rate, one at a time, and time every answer.

    Args:
        client: connected.
        states: (n, features), repeated as often as needed.
        seconds: how long.
        rate_hz: how often.
    """
    total = round(seconds * rate_hz)
    trips = np.full(total, np.nan)
    corrected = late = 0
    before = resource.getrusage(resource.RUSAGE_SELF)
    start = time.perf_counter()
    for index in range(total):
        due = start + index / rate_hz
        wait = due - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        begun = time.perf_counter()
        late += begun - due > 1e-3
        answer = client.ask(states[index % len(states)], (index + 1) / rate_hz)
        if answer is not None:
            trips[index] = time.perf_counter() - begun
            corrected += isinstance(answer.answer, Correction)
    elapsed = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_SELF)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    answered = int(np.isfinite(trips).sum())
    p50, p99 = np.nanpercentile(trips, [50, 99]) * 1e6 if answered else (np.nan, np.nan)
    return RoundTrips(
        total, answered, corrected, late, float(p50), float(p99), total / elapsed, used / elapsed
    )


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="benchmarks.online", description=__doc__)
    parser.add_argument("model", nargs="?", type=Path, default=api.shipped_model())
    parser.add_argument("--seconds", type=float, default=60.0, help="of states at 1 kHz")
    parser.add_argument("--realtime", action="store_true", help="server and sender in real time")
    given = parser.parse_args()
    states = simulate(10.0, 5).states
    print(update_line(given.model, states))
    if given.realtime and (refused := claim_realtime()):
        print(refused)
    lines = round_trip_lines(given.model, states, given.seconds, realtime=given.realtime)
    for line in lines:
        print(line)


def update_line(path: Path, states: Floats) -> str:
    """One update in this process."""
    server = EstimateServer(OnnxModel.load(path), ("127.0.0.1", 0))
    packets = [
        StatePacket(index + 1, 1e-3 * index, states[index % len(states)]).pack()
        for index in range(BLOCKS * BLOCK)
    ]
    spent = np.empty(len(packets))
    for index, packet in enumerate(packets):
        begun = time.perf_counter()
        server.answer(packet, server.address)
        spent[index] = time.perf_counter() - begun
    server.close()
    p50, p99 = 1e6 * np.percentile(spent, (50, 99))
    best = 1e6 * np.median(spent.reshape(BLOCKS, BLOCK), axis=1).min()
    return f"one update: median {p50:.0f} us, 99 % {p99:.0f} us; best block's median {best:.0f} us"


def round_trip_lines(
    path: Path, states: Floats, seconds: float, *, realtime: bool = False
) -> list[str]:
    """A robot that sends 1000 states a second to `measure estimate`."""
    words = [sys.executable, "-m", "measure", "estimate", str(path), "--port", "0", "--json"]
    words += ["--realtime"] if realtime else []
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        client = EstimateClient(("127.0.0.1", _port(server)))
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = time_round_trips(client, states, seconds)
        client.close()
        server.terminate()  # however late the last state was sent
        out, _ = server.communicate()
        counts = json.loads(out)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    load = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / seconds
    return [
        (
            f"UDP for {seconds:g} s at {done.rate_hz:.0f} Hz: {done.sent} sent, {done.answered} "
            f"answered, {counts['corrected']} corrected, {counts['lost']} lost; "
            f"{done.late} sent over a millisecond late"
        ),
        (
            f"round trip: median {done.p50_us:.0f} us, 99 % {done.p99_us:.0f} us; inside the "
            f"server: median {counts['p50_us']:.0f} us, 99 % {counts['p99_us']:.0f} us"
        ),
        f"load of a core: server {load:.0%} (its start included), client {done.client_load:.0%}",
    ]


def _port(server: subprocess.Popen[str]) -> int:
    """The port that the server says it listens on."""
    stream: Any = server.stderr
    for line in stream:
        if found := re.search(r"udp://[^:]+:(\d+)", line):
            return int(found[1])
    raise RuntimeError("the server ended before it listened")


if __name__ == "__main__":
    run_command(main)

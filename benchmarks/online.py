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
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import run_command
from measure import api
from measure.arrays import Floats
from measure.host import OnnxModel
from measure.learning import EstimateClient, EstimateServer, StatePacket, exercise
from measure.robots.simulator import simulate

BLOCKS, BLOCK = 10, 1000


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="benchmarks.online", description=__doc__)
    parser.add_argument("model", nargs="?", type=Path, default=api.shipped_model())
    parser.add_argument("--seconds", type=float, default=60.0, help="of states at 1 kHz")
    given = parser.parse_args()
    states = simulate(10.0, 5).states
    print(update_line(given.model, states))
    for line in round_trip_lines(given.model, states, given.seconds):
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


def round_trip_lines(path: Path, states: Floats, seconds: float) -> list[str]:
    """A robot that sends 1000 states a second to `measure estimate`."""
    words = [sys.executable, "-m", "measure", "estimate", str(path), "--port", "0", "--json"]
    words += ["--seconds", f"{seconds + 3.0:g}"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        client = EstimateClient(("127.0.0.1", _port(server)))
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = exercise(client, states, seconds)
        client.close()
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

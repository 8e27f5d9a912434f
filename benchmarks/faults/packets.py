"""Hostile senders of datagrams: `python -m benchmarks.faults packets --count N`.

N datagrams of every kind of wrong come between a robot's states to the estimator server, from other
ports; then the server is flooded while a robot sends 1000 states a second. No correction may differ
from those of a robot that is alone, and all of its states should be answered.
"""

from __future__ import annotations

import json
import random
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from benchmarks.online import time_round_trips
from measure.arrays import Floats
from measure.host import Correction
from measure_learning.api import shipped_model
from measure_learning.core import AnswerPacket, EstimateClient, EstimateServer, StatePacket
from measure_learning.onnx import OnnxModel
from measure_learning.simulator import simulate

FOREIGN_PORTS = range(50_000, 50_020)
FLOOD_HZ = 40_000
FLOOD_S = 10.0
ROBOT = ("127.0.0.1", 1)

_Draw = random.Random
_NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e39, -1e300, 5e-324)


def _whole(draw: _Draw, states: Floats) -> StatePacket:
    row = draw.randrange(len(states))
    return StatePacket(draw.randrange(10), draw.uniform(0.0, 10.0), states[row])


def _odd_feature(draw: _Draw, states: Floats) -> bytes:
    state = states[0].copy()
    state[draw.randrange(len(state))] = draw.choice(_NUMBERS[:4])
    with np.errstate(over="ignore"):
        return StatePacket(0, 1.0, state).pack()


def _odd_count(draw: _Draw, states: Floats) -> bytes:
    data = _whole(draw, states).pack()
    return data[:20] + struct.pack("<H", draw.randrange(1 << 16)) + data[22:]


KINDS: dict[str, Callable[[_Draw, Floats], bytes]] = {
    "noise": lambda draw, _: draw.randbytes(draw.randrange(600)),
    "22 bytes, no feature": lambda draw, _: StatePacket(0, 1.0, np.zeros(0)).pack(),
    "cut short": lambda draw, states: _whole(draw, states).pack()[: draw.randrange(493)],
    "too long": lambda draw, states: _whole(draw, states).pack() + bytes(draw.randrange(1, 99)),
    "another magic": lambda draw, states: b"TBe1" + _whole(draw, states).pack()[4:],
    "another count": _odd_count,
    "a feature that is no number": _odd_feature,
    "a stamp that is none": lambda draw, states: StatePacket(
        0, draw.choice(_NUMBERS[:3]), states[0]
    ).pack(),
    "a whole state": lambda draw, states: _whole(draw, states).pack(),
}


def difference_mm(
    count: int, seed: int, kinds: dict[str, Callable[..., bytes]] = KINDS
) -> tuple[float, Counter[str]]:
    """Send datagrams of these kinds between a robot's states.

    Returns:
        By how much a correction of the robot's differs at most from that of a robot which is
        alone, and what the others were answered.
    """
    states, draw = simulate(2.0, 5).states, random.Random(seed)
    model = OnnxModel.load(shipped_model())
    alone, server = model.another(), EstimateServer(model, ("127.0.0.1", 0))
    worst, answers = 0.0, Counter[str]()
    for index in range(count):
        if index % 20 == 0:
            turn = index // 20
            state, time_s = states[turn % len(states)], 1e-3 * turn
            wanted = alone.update(state.astype(np.float32).astype(float), time_s)
            packet = StatePacket(turn, time_s, state).pack()
            got = AnswerPacket.unpack(server.answer(packet, ROBOT)).answer
            if not isinstance(got, Correction):
                return float("inf"), answers
            worst = max(worst, float(np.abs(got.error_mm - wanted.error_mm).max()))
        name = draw.choice(list(kinds))
        sender = ("127.0.0.1", draw.choice(FOREIGN_PORTS))
        answer = AnswerPacket.unpack(server.answer(kinds[name](draw, states), sender)).answer
        answers["corrected" if isinstance(answer, Correction) else str(answer)] += 1
    server.close()
    return worst, answers


def flood(address: tuple[str, int], datagrams: list[bytes], over: threading.Event) -> int:
    """Send these from twenty ports, 40,000 a second, until it is over; how many were."""
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in FOREIGN_PORTS]
    for one in senders:
        one.connect(address)
        one.setblocking(False)
    begun, sent = time.perf_counter(), 0
    while not over.is_set():
        due = int((time.perf_counter() - begun) * FLOOD_HZ)
        for number in range(sent, due):
            try:
                senders[number % len(senders)].send(datagrams[number % len(datagrams)])
            except OSError:  # answers that nobody reads
                continue
        sent = due
        time.sleep(1e-3)
    for one in senders:
        one.close()
    return sent


@contextmanager
def _served() -> Iterator[tuple[tuple[str, int], subprocess.Popen[str]]]:
    command = [sys.executable, "-m", "measure", "estimate", "shipped", "--port", "0", "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        errors: Any = process.stderr
        found = re.search(r"udp://[^:]+:(\d+)", errors.readline())
        try:
            yield ("127.0.0.1", int(found[1]) if found else 0), process
        finally:
            process.kill()


_FLOODER = """
import sys, threading
from benchmarks.faults import packets
over, datagrams = threading.Event(), packets.flood_of(sys.argv[2])
threading.Thread(target=lambda: (sys.stdin.read(), over.set())).start()
print("floods", flush=True)
print(packets.flood(("127.0.0.1", int(sys.argv[1])), datagrams, over))
"""


def flood_of(name: str) -> list[bytes]:
    """The datagrams of a flood of one kind."""
    states, draw = simulate(2.0, 5).states, random.Random(1)
    return [KINDS[name](draw, states) for _ in range(64)]


def under_flood(name: str, seconds: float = FLOOD_S) -> str:
    """How a robot's states are answered meanwhile."""
    states = simulate(10.0, 5).states
    with _served() as (address, server):
        client = EstimateClient(address)
        client.ask(states[0], 0.0)
        with subprocess.Popen(
            [sys.executable, "-c", _FLOODER, str(address[1]), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as flooder:
            lines: Any = flooder.stdout
            lines.readline()
            time.sleep(0.5)
            done = time_round_trips(client, states, seconds)
            sent = int(flooder.communicate("")[0])
        client.close()
        server.terminate()
        counts = json.loads(server.communicate()[0])
    return (
        f"{done.answered} of {done.sent} answered, {done.corrected} corrected; round trip median "
        f"{done.p50_us:.0f} us, 99 % {done.p99_us:.0f} us; {counts['lost']} lost; of {sent} others "
        f"{sum(counts[kind] for kind in counts if ' ' in kind)} refused, "
        f"{counts['unanswered']} of them unanswered"
    )


def rows(count: int, seed: int) -> list[tuple[str, str]]:
    """What was sent, and what came of it."""
    worst, answers = difference_mm(count, seed)
    told = ", ".join(f"{n} {kind}" for kind, n in answers.most_common())
    out = [
        (f"{count} datagrams of others", f"robot's corrections differ by {worst:.1e} mm; {told}")
    ]
    floods = ("22 bytes, no feature", "noise", "a whole state")
    return out + [(f"40,000 a second: {name}", under_flood(name)) for name in floods]

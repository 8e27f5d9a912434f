"""Driving an estimator as a robot would, to see what the round trip costs."""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.host import Correction
from measure.learning.server import EstimateClient


@dataclass(frozen=True)
class Exercise:
    """What came of it.

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


def exercise(
    client: EstimateClient, states: Floats, seconds: float, rate_hz: float = 1000.0
) -> Exercise:
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
    return Exercise(
        total, answered, corrected, late, float(p50), float(p99), total / elapsed, used / elapsed
    )

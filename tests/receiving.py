"""Clients of sinks that receive in a thread while a test sends."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

import numpy as np

from benchmarks.sinks import CLIENTS, stored


@contextmanager
def receiving(where, goes_on=False):
    """What a client receives meanwhile; it has all when the block has ended, unless more comes."""
    received, over = [], threading.Event()
    client = CLIENTS[where.partition(":")[0]]

    def receive():
        for one in client(where, over.is_set):
            received.append(one)  # noqa: PERF402 - others look while it grows

    thread = threading.Thread(target=receive)
    thread.start()
    time.sleep(0.05)
    try:
        yield received
    finally:
        until_s, count = time.monotonic() + 10.0, -1
        while not goes_on and len(received) > count and time.monotonic() < until_s:
            count = len(received)
            time.sleep(0.5)
        over.set()
        thread.join()


def wait_for(condition, what="it"):
    until_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < until_s, f"{what} did not happen"
        time.sleep(0.005)


def check_same(received, run, relative_error=0.0, lost_too=True):
    """All that is stored was received, in order, to a millionth of a millimetre."""
    for stream, all_places in stored(run).items():
        places = [one for one in all_places if lost_too or one is not None]
        mine = [one.place for one in received if one.stream == stream]
        assert len(mine) == len(places), (stream, len(mine), len(places))
        for one, other in zip(mine, places, strict=True):
            assert (one is None) == (other is None)
            if other is not None:
                np.testing.assert_allclose(one, other, rtol=relative_error, atol=1.5e-6)

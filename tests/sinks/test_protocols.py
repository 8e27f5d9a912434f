"""Every sink is heard by a real client of its own protocol, on this machine."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from benchmarks.sinks import CLIENTS, address, write_run
from measure.host import Registry
from measure_studio.api import PlayOptions, play
from tests.receiving import check_same, receiving, wait_for

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
"""pyigtl's client leaves sockets open while there is no server yet."""
SINGLE = 2e-7  # of single precision, a share
PRECISION = {"igtl": SINGLE}
"""Relative errors of protocols that are not of double precision."""
WITHOUT_LOST = {"zenoh"}
"""Protocols that have no word for a pose that is lost."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two bodies, one relative to the other: no more poses than may wait for a sink."""
    return write_run(tmp_path_factory.mktemp("two") / "run", 80, 100.0, several=True)


@pytest.fixture(scope="module")
def registry():
    return Registry.discover()


@pytest.mark.parametrize("scheme", CLIENTS)
def test_all_that_is_played_is_received(run, registry, scheme):
    """By a client that was there before the sink; with the times of their turns."""
    lines, where = [], address(scheme)
    with receiving(where) as received:
        begun_s = time.time()
        end = play(run, registry, PlayOptions(wait_s=2.0, send=(where,), on_note=lines.append))
        ended_s = time.time()
    assert [one["lost"] for one in end.sent.values()] == [0], lines
    check_same(received, run, PRECISION.get(scheme, 0.0), scheme not in WITHOUT_LOST)
    tool = [one for one in received if one.stream == ("tool", "")]
    steps = np.diff([one.exposed_s for one in tool])
    np.testing.assert_allclose(steps, 0.01 * np.rint(steps / 0.01), atol=1e-3)
    assert np.median(steps) == pytest.approx(0.01, abs=1e-4)
    assert begun_s < tool[0].exposed_s < tool[-1].exposed_s < ended_s
    # By its own clock, not by another one: how soon they arrive is for benchmarks.live to say.
    assert np.median([one.arrived_s - one.exposed_s for one in tool]) < 5.0


@pytest.mark.parametrize("scheme", [one for one in CLIENTS if one != "udp"])
def test_a_client_that_comes_back_receives_again(run, registry, scheme):
    """It goes away in the middle, and another one comes."""
    where, lines = address(scheme), []
    over, ends = threading.Event(), []
    options = PlayOptions(loop=True, send=(where,), on_note=lines.append)
    thread = threading.Thread(target=lambda: ends.append(play(run, registry, options, over)))
    thread.start()
    try:
        for _ in range(2):
            with receiving(where, goes_on=True) as received:
                wait_for(lambda got=received: len(got) > 100)
    finally:
        over.set()
        thread.join()
    assert [one["lost"] for one in ends[0].sent.values()] == [0], lines

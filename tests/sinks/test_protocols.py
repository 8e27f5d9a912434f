"""Every sink is heard by a real client of its own protocol, on this machine."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, suppress

import numpy as np
import pytest

from benchmarks.sinks import CLIENTS, address, stored, write_run
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


@pytest.fixture(scope="module")
def played(run, registry):
    """What clients received that were there before their sinks, and what each sink says."""
    lines, wheres = [], {scheme: address(scheme) for scheme in CLIENTS}
    poses = [place for places in stored(run).values() for place in places]
    known = [place for place in poses if place is not None]
    with ExitStack() as stack:
        received = {s: stack.enter_context(receiving(w, goes_on=True)) for s, w in wheres.items()}
        begun_s, send = time.time(), tuple(wheres.values())
        end = play(run, registry, PlayOptions(wait_s=3.0, send=send, on_note=lines.append))
        between_s = begun_s, time.time()
        for scheme, some in received.items():
            count = len(known if scheme in WITHOUT_LOST else poses)
            with suppress(AssertionError):  # the test of this sink tells what is missing
                wait_for(lambda some=some, count=count: len(some) >= count)
    lost = dict(zip(wheres, (one["lost"] for one in end.sent.values()), strict=True))
    return received, lost, lines, between_s


@pytest.mark.parametrize("scheme", CLIENTS)
def test_all_that_is_played_is_received(run, played, scheme):
    """By a client that was there before the sink; with the times of their turns."""
    received, lost, lines, (begun_s, ended_s) = played
    assert lost[scheme] == 0, lines
    check_same(received[scheme], run, PRECISION.get(scheme, 0.0), scheme not in WITHOUT_LOST)
    tool = [one for one in received[scheme] if one.stream == ("tool", "")]
    steps = np.diff([one.exposed_s for one in tool])
    np.testing.assert_allclose(steps, 0.01 * np.rint(steps / 0.01), atol=1e-3)
    assert np.median(steps) == pytest.approx(0.01, abs=1e-4)
    assert begun_s < tool[0].exposed_s < tool[-1].exposed_s < ended_s
    # By its own clock, not by another one: how soon they arrive is for benchmarks.live to say.
    assert np.median([one.arrived_s - one.exposed_s for one in tool]) < 5.0


def test_clients_that_come_back_receive_again(run, registry):
    """They go away in the middle, and others come."""
    wheres, lines = [address(scheme) for scheme in CLIENTS if scheme != "udp"], []
    over, ends = threading.Event(), []
    options = PlayOptions(loop=True, send=tuple(wheres), on_note=lines.append)
    thread = threading.Thread(target=lambda: ends.append(play(run, registry, options, over)))
    thread.start()
    try:
        for _ in range(2):
            with ExitStack() as stack:
                some = [stack.enter_context(receiving(one, goes_on=True)) for one in wheres]
                for where, received in zip(wheres, some, strict=True):
                    wait_for(lambda got=received: len(got) > 100, where)
    finally:
        over.set()
        thread.join()
    assert [one["lost"] for one in ends[0].sent.values()] == [0] * len(wheres), lines

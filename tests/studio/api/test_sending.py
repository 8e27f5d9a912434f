"""What becomes of poses where a sink is slow, fails, or is taken: it is told, and nobody waits."""

from __future__ import annotations

import threading
import time

import pytest

from benchmarks.sinks import body, measurement
from measure.host import SentRun, Settings, Sink
from measure_studio.api.sending import Sending, sent_pose
from tests.receiving import wait_for

RUN = SentRun("run", (body("tool"),), ())


class Recording(Sink):
    """Keeps what it gets; fails and stalls as told."""

    name = "recording"
    form = "recording:ANYWHERE"

    def __init__(self):
        super().__init__(Settings(), "here", RUN)
        self.got, self.opened, self.closed = [], 0, 0
        self.go_on = threading.Event()
        self.go_on.set()
        self.refused_openings, self.error = 0, None

    def prepare(self):
        pass

    def open(self):
        self.opened += 1
        if self.opened <= self.refused_openings:
            raise OSError(98, "Address already in use")

    def send(self, pose):
        self.go_on.wait(20.0)
        if self.error is not None:
            raise self.error
        self.got.append(pose.frame)

    def close(self):
        self.closed += 1


def send(sending, frames):
    for frame in frames:
        sending.send([sent_pose(measurement(frame, frame / 100.0), "tool")])


def test_a_sink_that_stalls_costs_the_others_nothing():
    slow, quick, lines = Recording(), Recording(), []
    slow.go_on.clear()
    with Sending([("slow", slow), ("quick", quick)], lines.append) as sending:
        begun = time.monotonic()
        for frame in range(0, 1000, 100):
            send(sending, range(frame, frame + 100))
            wait_for(lambda last=frame + 99: quick.got[-1:] == [last])
        assert time.monotonic() - begun < 15.0
        assert quick.got == list(range(1000))
        slow.go_on.set()
        wait_for(lambda: slow.got[-1:] == [999])
        send(sending, [1000])
        wait_for(lambda: slow.got[-1:] == [1000])
    lost = sending.counts["slow"]["lost"]
    assert 0 < lost == 1001 - len(slow.got)
    assert slow.got[-200:] == list(range(801, 1001))  # the newest are kept
    assert sending.counts["quick"]["lost"] == 0
    assert [line for line in lines if line.startswith("slow")] == [
        "slow: it does not keep up; its poses are lost until that is mended",
        f"slow: works again; {lost} poses were lost",
        f"slow: {len(slow.got)} poses sent, {lost} lost",
    ]
    assert [line for line in lines if line.startswith("quick")] == [
        "quick: 1001 poses sent, none lost"
    ]


def test_a_port_that_is_taken_is_waited_for(monkeypatch):
    monkeypatch.setattr("measure_studio.api.sending.RETRY_S", 0.05)
    sink, lines = Recording(), []
    sink.refused_openings = 2
    with Sending([("it", sink)], lines.append) as sending:
        wait_for(lambda: lines)
        frame = 0
        while not sink.got:
            send(sending, [frame])
            frame += 1
            time.sleep(0.01)
        send(sending, range(frame, frame + 5))
        wait_for(lambda: len(sink.got) >= 6)
    lost = frame + 5 - len(sink.got)
    assert lost > 0
    assert lines == [
        "it: Address already in use; its poses are lost until that is mended",
        f"it: works again; {lost} poses were lost",
        f"it: {len(sink.got)} poses sent, {lost} lost",
    ]


def test_a_sink_that_raises_is_told_once_and_opened_again(monkeypatch):
    monkeypatch.setattr("measure_studio.api.sending.RETRY_S", 0.02)
    sink, lines = Recording(), []
    sink.error = ValueError("no such thing")
    with Sending([("it", sink)], lines.append) as sending:
        send(sending, range(3))
        wait_for(lambda: lines)
        sink.error = None
        while not sink.got:
            send(sending, [9])
            time.sleep(0.01)
    first, again, _ = lines
    assert "sink 'recording' fails (it): ValueError: no such thing (test_sending.py, line" in first
    assert again.startswith("it: works again; ")
    assert sink.closed >= 2


def test_the_end_does_not_wait_for_a_sink_that_hangs(monkeypatch):
    monkeypatch.setattr("measure_studio.api.sending._LAST_S", 0.1)
    sink, lines = Recording(), []
    sink.go_on.clear()
    begun = time.monotonic()
    with Sending([("it", sink)], lines.append) as sending:
        send(sending, range(10))
    assert time.monotonic() - begun < 10.0
    assert lines[-1].startswith("it: 0 poses sent, ")
    assert sending.counts["it"]["lost"] >= 9
    sink.go_on.set()


@pytest.mark.parametrize("undelivered", [0, 3])
def test_a_receiver_among_several_that_is_behind_is_told(undelivered):
    sink, lines = Recording(), []
    with Sending([("it", sink)], lines.append) as sending:
        send(sending, [0])
        wait_for(lambda: sink.got)
        for _ in range(undelivered):
            sink.undelivered += 1
            send(sending, [1])
            wait_for(lambda: len(sink.got) == 1 + sink.undelivered)
    assert sending.counts["it"]["lost"] == undelivered
    assert any("it does not keep up" in line for line in lines) == bool(undelivered)

"""Event marks of the lab: received by UDP and LSL, on the run's clock, and played with the run."""

from __future__ import annotations

import json
import os
import socket
import threading
import time

import pylsl
import pytest

from benchmarks.sinks import HOST, free_port, write_run
from measure.api import mark_event
from measure.errors import ConfigError
from measure.host import Registry
from measure_studio.api import TYPED, PlayOptions, play
from measure_studio.api.marks import marks_received
from tests.receiving import wait_for

SHIFT_S = 5000.0
"""The run's clock is that much ahead of this machine's, in these tests."""


def clock_s():
    return time.time() + SHIFT_S


def receiver_of(address, got):
    return marks_received([address], clock_s, lambda *mark: got.append(mark))


def test_marks_by_udp_have_the_time_of_their_arrival():
    got, port = [], free_port(socket.SOCK_DGRAM)
    with receiver_of(f"udp://:{port}", got), socket.socket(type=socket.SOCK_DGRAM) as lab:
        begun_s = clock_s()
        for data in (b"stimulus on\n", b'{"mark": "trial 2"}', b"\xff", b'{"other": 1}', b"[1]"):
            lab.sendto(data, (HOST, port))
        wait_for(lambda: len(got) == 5)
    assert [text for _, text in got] == ["stimulus on", "trial 2", "\ufffd", '{"other": 1}', "[1]"]
    assert all(begun_s <= time_s <= clock_s() for time_s, _ in got)


def test_marks_by_lsl_have_the_time_that_the_lab_gave_them():
    """They arrive two seconds after what they mark."""
    got, name = [], f"marks-{free_port()}"
    info = pylsl.StreamInfo(name, "Markers", 1, 0.0, pylsl.cf_string, name)
    with receiver_of(f"lsl:{name}", got):
        outlet = pylsl.StreamOutlet(info)
        wait_for(outlet.have_consumers)
        at_s = clock_s() - 2.0
        outlet.push_sample(["stimulus"], pylsl.local_clock() - 2.0)
        wait_for(lambda: got)
    ((time_s, text),) = got
    assert text == "stimulus"
    assert time_s == pytest.approx(at_s, abs=0.05)


def test_typed_lines_are_marks_and_an_empty_one_is_an_event(monkeypatch, caplog):
    """The end of the input is told in one line; nothing else comes of it."""
    got, (there, here) = [], os.pipe()
    with os.fdopen(there) as stream, receiver_typed(monkeypatch, stream, got):
        begun_s = clock_s()
        for text in (b"gras", b"ped\n\n", b"let go  \n"):
            os.write(here, text)
        wait_for(lambda: len(got) == 3)
        os.close(here)
        wait_for(lambda: caplog.messages)
    assert [text for _, text in got] == ["grasped", "event", "let go"]
    assert all(begun_s <= time_s <= clock_s() for time_s, _ in got)
    assert len(caplog.messages) == 1
    assert "no more marks can be typed; measuring goes on" in caplog.text


def test_without_an_input_marks_cannot_be_typed_and_nothing_else_suffers(monkeypatch, caplog):
    with receiver_typed(monkeypatch, None, []):
        wait_for(lambda: caplog.messages)
    assert len(caplog.messages) == 1


def receiver_typed(monkeypatch, stream, got):
    monkeypatch.setattr("sys.stdin", stream)
    return receiver_of(TYPED, got)


@pytest.mark.parametrize("address", ["udp://:0", "udp:5", "tcp://:5", "lsl:", "5005"])
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(ConfigError, match=f"--marks {address}: --marks takes udp://"):
        receiver_of(address, []).__enter__()


def test_a_port_that_is_taken_is_told():
    with socket.socket(type=socket.SOCK_DGRAM) as other:
        other.bind((HOST, 0))
        where = f"udp://{HOST}:{other.getsockname()[1]}"
        with pytest.raises(ConfigError, match=f"--marks {where}: Address already in use"):
            receiver_of(where, []).__enter__()


def test_marks_are_played_with_their_run(tmp_path):
    run, heard = write_run(tmp_path / "run", 20, 100.0), []
    mark_event(run, "grasped", 10.055)
    mark_event(run, "let go", 10.155)
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind((HOST, 0))
        receiver.settimeout(5.0)
        where = f"udp://{HOST}:{receiver.getsockname()[1]}"
        options = PlayOptions(send=(where,), wait_s=0.0)
        thread = threading.Thread(target=play, args=(run, Registry.discover(), options))
        thread.start()
        heard = [json.loads(receiver.recv(65_536)) for _ in range(22)]
        thread.join()
    places = [k for k, row in enumerate(heard) if "mark" in row]
    assert [heard[k]["mark"] for k in places] == ["grasped", "let go"]
    for k in places:
        assert heard[k - 1]["time_s"] < heard[k]["time_s"] <= heard[k + 1]["time_s"]

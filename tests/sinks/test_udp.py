"""Datagrams of poses: who hears them, and what they say in JSON and OSC."""

from __future__ import annotations

import json
import socket
import sys
import threading

import numpy as np
import pytest
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import ThreadingOSCUDPServer

from benchmarks.sinks import body, measurement
from measure.errors import ConfigError
from measure.host import EventMark, Registry, SentRun, Sink
from measure_studio.api.sending import sent_pose

RUN = SentRun("run", (body("tool"),), ())


def opened(address):
    scheme, _, rest = address.partition("://")
    where, _, query = rest.partition("?")
    settings = dict(item.split("=") for item in query.split("&") if item)
    sink = Registry.discover().build(Sink, scheme, settings, address=where, run=RUN)
    sink.open()
    return sink


def send(address, *frames):
    sink = opened(address)
    for frame in frames:
        sink.send(sent_pose(measurement(frame, frame / 100.0), "tool"))
    sink.send_mark(EventMark(1.25, 7.0, "stimulus"))
    sink.close()


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.settimeout(5.0)
        one.bind(("0.0.0.0", 0))
        yield one


def test_a_name_with_addresses_of_both_kinds_is_sent_to_by_ipv4(receiver, monkeypatch):
    port = receiver.getsockname()[1]
    both = [
        (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", port, 0, 0)),
        (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", port)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: both)
    send(f"udp://localhost:{port}", 3)
    assert json.loads(receiver.recv(65_536))["frame"] == 3
    assert json.loads(receiver.recv(65_536)) == {"mark": "stimulus", "time_s": 1.25}


@pytest.mark.skipif(sys.platform != "linux", reason="loopback broadcasts on Linux only")
def test_everyone_can_be_sent_to_at_once(receiver):
    send(f"udp://127.255.255.255:{receiver.getsockname()[1]}", 0)
    assert json.loads(receiver.recv(65_536))["frame"] == 0


def test_osc_is_read_by_a_program_of_osc():
    heard, done = [], threading.Event()
    dispatcher = Dispatcher()

    def hear(path, *values):
        heard.append((path, values))
        if path == "/triball/mark":
            done.set()

    dispatcher.set_default_handler(hear)
    with ThreadingOSCUDPServer(("127.0.0.1", 0), dispatcher) as server:
        server.daemon_threads = False  # so that closing it waits for all of them
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        send(f"udp://127.0.0.1:{server.server_address[1]}?format=osc", 8, 9, 49)
        assert done.wait(10.0)
        server.shutdown()
        thread.join()
    said = dict(heard)
    assert said["/triball/tool/lost"] == (49, 0.49, "lost", "too few balls")
    assert said["/triball/mark"] == ("stimulus", 1.25)
    poses = {values[0]: values for path, values in heard if path == "/triball/tool/pose"}
    assert (poses[8][-1], poses[9][-1]) == ("ok", "flagged")
    pose = measurement(8, 0.08).pose
    place = [*pose.world_from_body.translation, *pose.world_from_body.quat_wxyz]
    sds = [pose.position_sd_mm, pose.rotation_sd_deg]
    np.testing.assert_allclose(poses[8][1:-1], [0.08, *place, *sds], rtol=1e-6)


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pythonosc.osc_message_builder", None)
    with pytest.raises(ConfigError, match=r"needs the extra 'osc': pip install 'triball\[osc\]'"):
        opened("udp://127.0.0.1:5?format=osc")

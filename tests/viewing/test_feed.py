"""A viewer that freezes, is slow, or goes away holds up nobody, and is named in one line."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import rerun as rr
import rerun.blueprint as rrb

from measure.viewing import entities, recording
from measure.viewing.recording import RunRecording, ViewerFeed, is_whole, open_recording
from tests.measurements import BODY, CAMERAS, measurement
from tests.viewing.reading import column, read_recording

SLOW = "does not keep up: what it does not take is not shown there"
LAYOUT = rrb.Blueprint()


class Frozen:
    """It accepts connections and reads nothing."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.taken: list[socket.socket] = []
        self.address = f"rerun+http://127.0.0.1:{self._server.getsockname()[1]}/proxy"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                self.taken.append(self._server.accept()[0])
            except OSError:
                return

    def end(self) -> None:
        """As if it was killed: the system closes its connections."""
        self._server.shutdown(socket.SHUT_RDWR)  # or the thread would accept one more
        self._server.close()
        for one in self.taken:
            one.close()


@pytest.fixture
def frozen() -> Iterator[Frozen]:
    server = Frozen()
    yield server
    with suppress(OSError):  # it has ended
        server.end()


def wait_until(holds, what: str) -> None:
    until_s = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < until_s, what
        time.sleep(0.02)


def test_a_frozen_viewer_costs_neither_poses_nor_the_file(frozen, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "SLOW_S", 0.5)
    said, path = list[str](), tmp_path / "run.rrd"
    stream = open_recording("test", CAMERAS, path, frozen.address, note=said.append)
    began_s = time.monotonic()
    with RunRecording(stream, [BODY], CAMERAS, 0, live=True) as run:
        for index in range(20):
            run.add([measurement(index)])
    assert time.monotonic() - began_s < 10
    assert said == [f"the viewer at {frozen.address} {SLOW}"]
    assert is_whole(path)
    assert sorted(column(read_recording(path)[entities.POSITION_SD], "Scalars:scalars")) == [
        *range(20)
    ]


def test_a_viewer_that_goes_away_is_named_once_and_the_file_goes_on(frozen, tmp_path):
    said, path = list[str](), tmp_path / "run.rrd"
    stream = open_recording("test", CAMERAS, path, frozen.address, note=said.append)
    with RunRecording(stream, [BODY], CAMERAS, 0, live=True) as run:
        run.add([measurement(0)])
        wait_until(lambda: len(frozen.taken) > 1, "it connects, after it was looked for")
        frozen.end()
        wait_until(lambda: said, "it is gone")
        for index in range(1, 20):
            run.add([measurement(index)])
    assert said == [f"the viewer at {frozen.address} is gone: the rest is not shown there"]
    assert is_whole(path)


def test_python_ends_at_once_beside_a_frozen_viewer(frozen):
    program = (
        "import rerun as rr, rerun.blueprint as rrb\n"
        "from measure.viewing import recording\n"
        "recording.SLOW_S = 0.5\n"
        f"viewer = recording.ViewerFeed({frozen.address!r}, print, rrb.Blueprint())\n"
        "viewer.log('a', rr.TextLog('something'))\n"
        "viewer.close()\n"
        "print('the end')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=100, check=True
    )
    assert done.stdout.splitlines() == [f"the viewer at {frozen.address} {SLOW}", "the end"]
    assert done.stderr == ""


class Slow:
    """A stream of Rerun's whose viewer takes nothing until it is let."""

    def __init__(self, *_: object, **__: object) -> None:
        self.let, self.taken = threading.Event(), list[str]()

    def set_sinks(self, *_: object, **__: object) -> None:
        self.let.wait()

    def log(self, entity: str, *_: object, static: bool) -> None:
        self.taken.append(entity)

    def flush(self) -> None:
        pass

    disconnect = flush


@pytest.fixture
def slow(monkeypatch):
    monkeypatch.setattr(recording.rr, "RecordingStream", Slow)
    monkeypatch.setattr(recording.rr, "GrpcSink", lambda _: None)
    monkeypatch.setattr(recording.rr, "unregister_shutdown", lambda: None)
    said = list[str]()
    return ViewerFeed("here", said.append, LAYOUT), said


def test_what_waits_for_a_viewer_has_a_bound_and_what_is_left_out_is_counted(slow, monkeypatch):
    monkeypatch.setattr(recording, "HELD_BYTES", 1000)
    viewer, said = slow
    for k in range(10):
        viewer.log(f"{k}", rr.Scalars([0.0] * 40))  # 320 bytes of numbers and what frames them
    assert said == [f"the viewer at here {SLOW}"]
    viewer._stream.let.set()
    viewer.close()
    assert viewer._stream.taken == [f"{k}" for k in range(len(viewer._stream.taken))]
    left_out = 10 - len(viewer._stream.taken)
    assert said[1:] == [f"the viewer at here keeps up again; {left_out} messages were left out"]


def test_an_interrupt_ends_the_wait_for_a_viewer(slow, monkeypatch):
    viewer, said = slow
    viewer.log("a", rr.Scalars(0.0))

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer._thread, "join", interrupt)
    viewer.close()
    assert said == [f"the viewer at here {SLOW}"]
    viewer._stream.let.set()


def test_a_viewer_that_keeps_up_gets_all_and_is_not_spoken_of(slow):
    viewer, said = slow
    viewer._stream.let.set()
    for k in range(200):
        viewer.log(f"{k}", rr.Scalars(0.0))
    viewer.close()
    assert viewer._stream.taken == [f"{k}" for k in range(200)]
    assert said == []

"""Runs played into sinks, by command line and in one call."""

from __future__ import annotations

import json
import signal
import socket
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr

from benchmarks.sinks import address, write_run
from measure.cli import main
from measure.host import Registry
from measure.viewing import entities, recording
from measure_studio.api import PlayOptions, play
from tests.receiving import check_same, receiving
from tests.results.conftest import BODY, measurement, written
from tests.viewing.reading import column, read_recording

pytestmark = pytest.mark.usefixtures("signals")

FRAMES = 150


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("one") / "run", FRAMES, 200.0)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two bodies, one relative to the other."""
    return write_run(tmp_path_factory.mktemp("two") / "run", 60, 200.0, several=True)


def test_every_pose_is_received_at_its_turn(run, capsys):
    where = address("udp")
    begun = time.monotonic()
    with receiving(where) as received:
        assert main(["play", str(run), "--send", where, "--wait-s", "0", "--json"]) == 0
    assert time.monotonic() - begun > 0.9 * FRAMES / 200.0
    told = capsys.readouterr()
    counts = json.loads(told.out)
    assert counts["frame_sets"] == FRAMES
    assert counts["sent"] == {where: {"sent": FRAMES, "lost": 0}}
    assert told.err.splitlines() == [f"{where}: {FRAMES} poses sent, none lost"]
    check_same(received, run)
    steps = np.diff([one.exposed_s for one in received])
    np.testing.assert_allclose(steps, 1 / 200.0, atol=1e-5)


def test_the_machines_clock_may_be_set_back_meanwhile(run, monkeypatch):
    """Poses keep their turns, and none is known before its pictures were taken."""
    count, clock = 0, SimpleNamespace(**vars(time))

    def set_back():
        nonlocal count
        count += 1
        return time.time() - (3600.0 if count > 1 else 0.0)

    clock.time = set_back
    for module in [one for name, one in sys.modules.items() if name.startswith("measure.")]:
        if getattr(module, "time", None) is time:
            monkeypatch.setattr(module, "time", clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        where = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
        end = play(run, Registry.discover(), PlayOptions(wait_s=0.0, rate=20.0, send=(where,)))
        rows = [json.loads(receiver.recv(65_536)) for _ in range(end.frame_sets)]
    assert end.frame_sets == FRAMES
    assert np.all(np.diff([row["exposed_s"] for row in rows]) > 0)
    ages_s = [row["known_s"] - row["exposed_s"] for row in rows]
    assert 0 <= min(ages_s) <= max(ages_s) < 5


def test_bodies_and_relative_poses_are_named(two):
    where = address("udp")
    with receiving(where) as received:
        play(two, Registry.discover(), PlayOptions(wait_s=0.0, rate=4.0, send=(where,)))
    check_same(received, two)
    assert {one.stream for one in received} == {("tool", ""), ("base", ""), ("tool", "base")}


def test_what_is_sent_is_what_the_run_holds(run):
    """All the columns of a row, with its reasons."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5.0)
        where = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
        play(run, Registry.discover(), PlayOptions(wait_s=0.0, rate=20.0, send=(where,)))
        rows = [json.loads(receiver.recv(65_536)) for _ in range(50)]
    assert {"frame", "time_s", "covariance", "rms_px", "flags", "cameras"} <= rows[0].keys()
    assert "body" not in rows[0]
    assert rows[9]["status"] == "flagged"
    assert rows[9]["reason"] == "the balls are far apart"
    assert rows[9]["doubts"] == [{"code": "other", "text": rows[9]["reason"]}]
    assert (rows[49]["status"], rows[49]["x_mm"]) == ("lost", None)
    assert rows[49]["reason"] == "too few balls"
    covariance = np.reshape(rows[3]["covariance"], (6, 6))
    assert covariance[0, 0] == pytest.approx(0.02**2 + 1e-10)
    assert rows[3]["time_s"] == pytest.approx(10.0 + 3 / 200.0)


def test_an_interrupt_ends_a_loop(run, capsys):
    where = address("udp")

    def interrupt():
        while len(received) <= 2 * FRAMES and time.monotonic() < begun + 30.0:
            time.sleep(0.01)
        signal.raise_signal(signal.SIGINT)

    begun = time.monotonic()
    with receiving(where) as received:
        thread = threading.Thread(target=interrupt)
        thread.start()
        words = ["play", str(run), "--rate", "10", "--loop", "--send", where, "--wait-s", "0"]
        assert main([*words, "--json"]) == 0
        thread.join()
    assert json.loads(capsys.readouterr().out)["frame_sets"] > 2 * FRAMES


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("--send", "nowhere"), "--send nowhere: no sink is called 'nowhere'; --send takes "),
        (("--send", "osc://127.0.0.1:1"), "--send osc://127.0.0.1:1: no sink is called 'osc'; "),
        (("--send", "udp://127.0.0.1:x"), "udp://127.0.0.1:x: expected HOST:PORT, such as "),
        (("--send", "udp://127.0.0.1:5?form=osc"), "unknown setting 'form'; it has format"),
        (("--send", "udp://127.0.0.1:5", "--set", "udp.format=xml"), "'format': input should be"),
        (("--send", "udp://127.0.0.1:5", "--set", "igt.x=1"), "--set igt.x=1: expected SINK.NAME"),
        (("--send", "udp://nowhere.invalid:5"), "cannot send to nowhere.invalid:5"),
        (("--rate", "0", "--send", "udp://127.0.0.1:5"), "--rate 0: expected a number above 0"),
        ((), "where is it to be played to?"),
    ],
)
def test_what_cannot_be_played_is_one_line(run, capsys, more, told):
    assert main(["play", str(run), *more]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    if "--send" in more and "--rate" not in more and "--set" not in more:
        assert "udp://HOST:PORT" in line


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    assert main(["play", str(tmp_path), "--send", "udp://127.0.0.1:5"]) == 2
    assert "is no run" in capsys.readouterr().err


def test_a_viewer_is_shown_poses_and_balls(tmp_path, monkeypatch):
    written(tmp_path / "run", [measurement(k, lost=k == 3) for k in range(5)])
    monkeypatch.setattr(recording, "check_listening", lambda address: None)
    monkeypatch.setattr(recording.rr, "GrpcSink", lambda _: rr.FileSink(tmp_path / "seen.rrd"))
    options = PlayOptions(connect="nowhere", wait_s=0.0, rate=10.0)
    assert play(tmp_path / "run", Registry([]), options).frame_sets == 5
    seen = read_recording(tmp_path / "seen.rrd")
    trail = column(seen[entities.TRAIL], "Points3D:positions")
    balls = column(seen[entities.ball("green")], "Ellipsoids3D:centers")
    for k in (0, 1, 2, 4):
        pose = measurement(k).pose.world_from_body
        np.testing.assert_allclose(trail[k], [pose.translation], atol=1e-4)
        np.testing.assert_allclose(balls[k], pose.apply(BODY.centers[:1]), atol=1e-4)
    assert not trail[3]

"""Cameras measured while they deliver, over real HTTP on loopback, against exact truth."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from benchmarks.faults.cameras import FAULTS
from benchmarks.faults.hostile_camera import LOGIN, TOKEN, HostileCamera, hostile
from benchmarks.sinks import free_port
from measure.api import events
from measure.api import run as measure_run
from measure.api.profiles import load_profile
from measure.cli import main
from measure.host import Registry
from measure.results import read_run
from measure.session import read_calibration, read_trajectory
from measure_studio.api import LiveOptions, live, parse_cameras
from tests.camera_server import ServedCamera, serving
from tests.simulated.knocked import TURN_DEG, turning

pytestmark = pytest.mark.usefixtures("signals")

PERIOD_S = 0.1
"""A busy machine may take its time."""


@pytest.fixture
def session(still):
    """Twelve frame sets of rendered balls that move by a millimetre or two from one to the next."""
    return still


def served(session, **manners):
    """The session's cameras, in step."""
    return {
        f"cam{k}": ServedCamera(
            [file.read_bytes() for file in sorted((session / f"cam{k}").glob("*.jpg"))],
            PERIOD_S,
            stamps=True,
            **manners,
        )
        for k in range(4)
    }


def words(command, session, addresses, out, *more):
    """A command line; the body and the calibration are the session's."""
    files = ["--calibration", session / "calibration.toml", "--body", session / "body.toml"]
    cameras = [f"{name}={address}" for name, address in addresses.items()]
    return [str(word) for word in (command, *cameras, "-o", out, *files, *more)]


def errors_mm(poses, cameras, session):
    """Distance of poses, rows of a table, from where the body was in the pictures of their time."""
    truth = read_trajectory(session / "truth.csv")
    taken, which = np.array(sorted(set(cameras["cam0"].taken_s))).T
    out = []
    for time_s, x, y, z in poses:
        nearest = np.argmin(np.abs(taken - time_s))
        assert abs(taken[nearest] - time_s) < PERIOD_S / 2
        there = truth.at([which[nearest] / 30]).translation[0]
        out.append(np.linalg.norm([x, y, z] - there))
    return np.array(out)


def rows(run):
    """Time and place of every frame set of a run with a pose."""
    with (run / "poses.csv").open() as file:
        found = [row for row in csv.DictReader(file) if row["x_mm"]]
    return [[float(row[c]) for c in ("time_s", "x_mm", "y_mm", "z_mm")] for row in found]


class Receiver:
    """Whoever listens to poses."""

    def __init__(self, stack):
        self.received = []
        self._socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.1)
        self._over = threading.Event()
        thread = threading.Thread(target=self._listen)
        thread.start()
        stack.callback(thread.join)
        stack.callback(self._over.set)

    @property
    def port(self):
        return self._socket.getsockname()[1]

    def wait_for(self, count):
        until_s = time.monotonic() + 200.0
        while len(self.received) < count:
            assert time.monotonic() < until_s, "the poses did not come"
            time.sleep(0.05)

    def _listen(self):
        while not self._over.is_set():
            try:
                self.received.append(json.loads(self._socket.recv(65_536)))
            except TimeoutError:
                continue


def mark_and_end(receiver, port):
    """Tell of an event once there are poses, and end it some poses later."""
    receiver.wait_for(3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lab:
        lab.sendto(b"grasped", ("127.0.0.1", port))
    receiver.wait_for(15)
    signal.raise_signal(signal.SIGINT)


@pytest.mark.slow
def test_poses_are_there_while_the_cameras_deliver(session, tmp_path, capsys):
    """And they are sent on, recorded with their pictures, and right."""
    cameras, run, kept = served(session), tmp_path / "run", tmp_path / "kept"
    with ExitStack() as stack:
        receiver = Receiver(stack)
        addresses = stack.enter_context(serving(cameras))
        more = ("--seconds", "250", "--send", f"udp://127.0.0.1:{receiver.port}", "--record", kept)
        lab = free_port(socket.SOCK_DGRAM)
        more = (*more, "--marks", f"udp://127.0.0.1:{lab}")
        thread = threading.Thread(target=mark_and_end, args=(receiver, lab))
        thread.start()
        stack.callback(thread.join)
        assert main([*words("live", session, addresses, run, *more), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frame_sets"] >= 8
    assert told["ok"] >= told["frame_sets"] - 4
    assert told["age_s"] < 10 * PERIOD_S
    poses = rows(run)
    # The last pictures came while it was ended: not of all cameras.
    errors = errors_mm(poses[:-1], cameras, session)
    assert np.sqrt(np.mean(errors**2)) < 0.06
    ((marked_s, what),) = events(run)
    assert what == "grasped"
    assert poses[0][0] < marked_s < poses[-1][0] + 5 * PERIOD_S
    sent_on = [one for one in receiver.received if "mark" in one]
    assert [one["mark"] for one in sent_on] == ["grasped"]
    received = [one for one in receiver.received if "mark" not in one]
    assert len(received) == told["frame_sets"]
    for sent, (time_s, *place) in zip(received, poses, strict=True):
        assert sent["time_s"] == pytest.approx(time_s, abs=1e-6)
        assert [sent[axis] for axis in ("x_mm", "y_mm", "z_mm")] == pytest.approx(place, abs=1e-6)
        assert np.reshape(sent["covariance"], (6, 6)).diagonal().min() > 0
    measured = read_run(run)
    assert measured.finished
    assert measured.session == kept / "session.toml"
    assert not measured.provenance["profile"]["smoothing"]
    assert main(["report", str(run)]) == 0
    assert (run / "run.rrd").stat().st_size > 10_000
    again = measure_run(kept, tmp_path / "again", load_profile("precise"), Registry.discover())
    assert again.ok > 0.9 * again.frame_sets
    recorded = errors_mm(rows(tmp_path / "again")[:-1], cameras, session)
    assert np.sqrt(np.mean(recorded**2)) < 0.06


@pytest.mark.slow
def test_a_request_to_end_ends_it_as_it_should_end(session, tmp_path):
    out = tmp_path / "run"
    with serving(served(session)) as addresses:
        how = ("--no-recording", "--images", "none", "--profile", "paper")
        command = words("live", session, addresses, out, *how)
        process = subprocess.Popen(
            [sys.executable, "-m", "measure", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[3],
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        try:
            for line in process.stderr:
                if "known after" in line:
                    break
            process.send_signal(signal.SIGTERM)  # SIGINT: where a camera is away, below
            printed, _ = process.communicate(timeout=200)
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 0
    assert "frame sets measured" in printed
    assert read_run(out).finished


@pytest.mark.slow
def test_a_camera_beside_its_place_is_flagged(session, tmp_path):
    """Two cameras' addresses exchanged: nothing of it is believed."""
    out, rig, stop = tmp_path / "run", session / "calibration.toml", threading.Event()

    def hear(state):
        if state.frame_sets > 3:
            stop.set()

    with serving(served(session)) as addresses:
        addresses["cam0"], addresses["cam1"] = addresses["cam1"], addresses["cam0"]
        cameras = parse_cameras([f"{name}={address}" for name, address in addresses.items()])
        how = load_profile("precise"), Registry.discover(), LiveOptions(seconds=250.0, stop=stop)
        end = live(cameras, out, rig, [session / "body.toml"], *how, hear)
    assert end.summary.frame_sets > 3
    wrong = read_run(out)
    believed = [row for row in wrong.poses.to_pylist() if row["status"] == "ok"]
    assert believed == []


@pytest.mark.slow
def test_a_camera_that_is_knocked_is_brought_back(session, tmp_path):
    """Once it has shown the moving body from its new place for a while."""
    cameras, out, stop = served(session), tmp_path / "run", threading.Event()
    rig = session / "calibration.toml"
    camera = read_calibration(rig).camera("cam1")
    shown = sorted((session / "cam1").glob("*.jpg"))
    later, seen = [*map(turning(camera), shown)], []

    def hear(state):
        seen.append(state)
        if state.frame_sets == 6:
            cameras["cam1"].pictures = later
        changes = state.latest[0].rig.changes
        if changes and changes[-1].world_from_camera and "cam1" in state.latest[0].pose.cameras:
            stop.set()

    with serving(cameras) as addresses:
        given = parse_cameras([f"{name}={address}" for name, address in addresses.items()])
        how = load_profile("precise"), Registry.discover(), LiveOptions(seconds=250.0, stop=stop)
        live(given, out, rig, [session / "body.toml"], *how, hear)
    run = read_run(out)
    left_out, back = run.camera_changes
    assert left_out.world_from_camera is None
    turn = (camera.world_from_camera.inverse() @ back.world_from_camera).rotvec
    off_deg = np.linalg.norm(np.degrees(turn) - TURN_DEG)
    assert off_deg < 3 * np.degrees(np.sqrt(np.trace(back.covariance[3:, 3:])))
    away = [one.latest[0] for one in seen[left_out.frame_set : back.frame_set]]
    assert away
    for one in away:
        assert "cam1 was moved, and is left out" in one.doubts
        assert one.pose is None or "cam1" not in one.pose.cameras
    (said,) = [f for f in run.summary.findings if f.code == "moved-at"]
    assert (said.level, said.subject) == ("note", "cam1")


def test_recording_keeps_every_byte_and_its_time(session, tmp_path, capsys):
    cameras, out = served(session), tmp_path / "kept"
    with serving(cameras) as addresses:
        assert main([*words("record", session, addresses, out, "--seconds", "2"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    for name, camera in cameras.items():
        stamps = np.loadtxt(out / f"{name}.csv", delimiter=",", skiprows=1)
        files = sorted((out / name).iterdir())
        assert told["cameras"][name]["pictures"] == len(files) == len(stamps) >= 8
        taken, which = np.array(camera.taken_s).T
        for file, (_, time_s) in zip(files, stamps, strict=True):
            nearest = np.argmin(np.abs(taken - time_s))
            assert abs(taken[nearest] - time_s) < 0.03
            assert file.read_bytes() == camera.pictures[int(which[nearest])]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            {"cam1": "http://127.0.0.1:1/x"},
            "camera 'cam1': http://127.0.0.1:1/x: Connection refused",
        ),
        ({"cam9": "http://127.0.0.1:1/x"}, "no calibration of camera 'cam9'"),
        ({"cam0": "nothing.mp4"}, "camera 'cam0': nothing.mp4 is no video file"),
    ],
)
def test_refused_recordings_print_one_line_and_leave_nothing(
    session, tmp_path, capsys, change, told
):
    out = tmp_path / "kept"
    with serving(served(session)) as addresses:
        assert main(words("record", session, {**addresses, **change}, out)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not out.exists()


@pytest.mark.parametrize(
    ("command", "out", "more", "told"),
    [
        ("record", "s", "--seconds 0", "--seconds 0: expected a time above 0"),
        ("record", "s", "--size big", "--size big: expected WIDTHxHEIGHT"),
        ("record", "s", "--rate 0", "--rate 0: expected pictures a second, above 0"),
        ("record", "s", "--rate 30", "and --lock are for cameras of this machine: none is given"),
        ("live", "kept", "--record kept", "a recording needs a folder of its own"),
        ("live", "kept/run", "--record kept", "a recording needs a folder of its own"),
        ("live", "kept/../kept", "--record kept", "a recording needs a folder of its own"),
        ("live", "r", "--send nowhere", "no sink is called 'nowhere'; --send takes "),
        ("live", "r", "--marks udp:5006", "--marks udp:5006: --marks takes udp://HOST:PORT"),
    ],
)
def test_what_cannot_be_done_is_refused_first(
    session, tmp_path, capsys, monkeypatch, command, out, more, told
):
    monkeypatch.chdir(tmp_path)
    addresses = dict.fromkeys(("cam0", "cam1"), "http://127.0.0.1:1/")
    assert main(words(command, session, addresses, out, *more.split())) == 2
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_interrupt_ends_the_wait_for_a_camera_at_once(session, tmp_path, capsys):
    """Sent once a camera is asked: before, libraries being loaded may take it for a fault."""
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    sent_s = []
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}/"

        def interrupt():
            connection, _ = silent.accept()
            with connection:
                connection.recv(1000)
                sent_s.append(time.monotonic())
                signal.raise_signal(signal.SIGINT)
                over.wait(60.0)

        over = threading.Event()
        thread = threading.Thread(target=interrupt)
        thread.start()
        assert main(words("record", session, {"cam0": address}, tmp_path / "kept")) == 130
        assert time.monotonic() - sent_s[0] < 10.0
        over.set()
        thread.join()
    assert capsys.readouterr().err == "measure: interrupted\n"
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_a_camera_that_is_away_is_told_in_lines_and_rows(session, tmp_path, capsys):
    """At once, once, and when it is back; the poses without it are believed."""
    reason, said = "cam2 is away", "no picture came"
    pictures = [
        [file.read_bytes() for file in sorted((session / f"cam{k}").glob("*.jpg"))]
        for k in range(4)
    ]
    begun_s = time.time()
    cameras = [
        HostileCamera(mine, pictures[k - 1], PERIOD_S, begun_s) for k, mine in enumerate(pictures)
    ]
    ill = next(one for one in FAULTS if one.name == "stall")
    out = tmp_path / "run"
    with hostile(cameras) as found, ExitStack() as stack:
        receiver = Receiver(stack)

        def fail():
            receiver.wait_for(10)
            cameras[2].fault = ill
            time.sleep(2.0)
            cameras[2].fault = None
            time.sleep(2.0)
            receiver.wait_for(len(receiver.received) + 5)
            signal.raise_signal(signal.SIGINT)

        thread = threading.Thread(target=fail)
        thread.start()
        stack.callback(thread.join)
        addresses = {f"cam{k}": address for k, address in enumerate(found)}
        more = ("--send", f"udp://127.0.0.1:{receiver.port}", "--seconds", "250", "--no-recording")
        assert main([*words("live", session, addresses, out, *more), "--json"]) == 0
    printed = capsys.readouterr()
    lines = [line for line in printed.err.splitlines() if line.startswith("cam2 is ")]
    assert [line.split()[2] for line in lines] == ["away:", "back"]
    assert lines[0].endswith(said)
    (outage,) = json.loads(printed.out)["cameras"]["cam2"]["outages"]
    assert outage["reason"] == said
    assert 1.5 < outage["until_s"] - outage["since_s"] < 8.0
    rows = read_run(out).poses.to_pylist()
    without = [row for row in rows if reason in row["reason"]]
    assert len(without) >= 5
    assert all("cam2" not in row["cameras"] for row in without)
    assert sum(row["status"] == "ok" for row in without) > len(without) / 2
    first = without[0]["time_s"]
    assert outage["since_s"] - 3 * PERIOD_S < first < outage["since_s"] + 3 * PERIOD_S + 1.0
    assert not [row for row in rows if row["time_s"] < first and "away" in row["reason"]]
    # The last one may lack pictures that were on their way when it was interrupted.
    assert [row["reason"] for row in rows[-4:-1]] == ["", "", ""]
    text = "".join(path.read_text("utf-8", "replace") for path in out.iterdir())
    assert LOGIN.partition(":")[2] not in text + printed.err + printed.out
    assert TOKEN not in text + printed.err + printed.out

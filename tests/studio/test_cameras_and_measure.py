"""In a browser: cameras are looked at, fall out and come back, and are measured."""

from __future__ import annotations

import csv
import shutil
import socket
import urllib.error
import urllib.request

import numpy as np
import pytest

from measure.cli import main
from measure.results import read_run
from measure.session import read_trajectory
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium, find_chromium
from tests.faults.cameras import FAULTS
from tests.faults.hostile_camera import HostileCamera, hostile
from tests.studio.desk import FOOT, choose, fill, press, studio

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(find_chromium() is None, reason="no chromium on this machine"),
]
PERIOD_S = 0.25
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length == {}"
STATE = "document.querySelector('[data-camera={}]')?.innerText.includes('{}')"


def pictures(session, k):
    return [file.read_bytes() for file in sorted((session / f"cam{k}").glob("*.jpg"))]


def test_from_addresses_to_a_pose_that_is_right(still, tmp_path):
    """Cameras are typed in; the body is measured by them, live; what is left is a run."""
    folder = tmp_path / "desk"
    folder.mkdir()
    for name in ("calibration.toml", "body.toml"):
        shutil.copy(still / name, folder)
    cameras = {f"cam{k}": ServedCamera(pictures(still, k), PERIOD_S, stamps=True) for k in range(4)}
    with serving(cameras) as addresses, studio(folder) as address, Chromium(1280, 800) as page:
        page.open(address)
        for name, stream in addresses.items():
            fill(page, "Address, as http://10.0.0.5:8080/?action=stream or 0", stream)
            fill(page, "Name", name)
            press(page, "add$")
            page.wait_for(f"!!document.querySelector('[data-camera={name}]')", 20)
        page.wait_for(SHOWN.format(4), 30)
        page.wait_for(STATE.format("cam3", "its own clock"), 20)
        page.wait_for(STATE.format("cam3", "1280 x 720 px"), 20)
        page.open(address + "measure")
        choose(page, "Profile", "paper")
        press(page, "measure$")
        page.wait_for("document.querySelector('[data-pose]')?.innerText.includes('±')", 60)
        page.send("Input.dispatchKeyEvent", type="keyDown", key="m", code="KeyM", text="m")
        page.wait_for("document.querySelector('[data-events]').innerText.includes('1. event')", 20)
        page.idle(1.0)
        press(page, "stop")
        page.wait_for(f"/run-1: .* believed/.test({FOOT})", 30)
        page.wait_for("!!document.querySelector('a[href$=\"run-1/report.html\"]')", 20)
        assert page.errors == []
        assert [r for r in page.requests if not r.startswith((address, "blob:", "data:"))] == []
        report = urllib.request.urlopen(f"{address}file/run-1/report.html").read()
        assert b"<html" in report[:200].lower()
        for elsewhere in ("%2e%2e/secret.csv", "/etc/hosts.csv", "run-1/run.toml", "no.html"):
            with pytest.raises(urllib.error.HTTPError, match=r"403|404"):
                urllib.request.urlopen(f"{address}file/{elsewhere}")
    assert (folder / "cameras.txt").read_text() == "".join(
        f"{n}={a}\n" for n, a in addresses.items()
    )
    run, truth = read_run(folder / "run-1"), read_trajectory(still / "truth.csv")
    assert run.finished
    assert run.session == folder / "session-1" / "session.toml"
    with (folder / "run-1" / "events.csv").open() as file:
        (event,) = csv.DictReader(file)
    assert run.times_s[0] < float(event["time_s"]) < run.times_s[-1] + 1
    taken, which = np.array(sorted(set(cameras["cam0"].taken_s))).T
    poses = run.poses.filter(run.has_pose).to_pylist()
    assert len(poses) >= 2
    for pose in poses:
        there = which[np.argmin(np.abs(taken - pose["time_s"]))] / 30
        place = [pose[axis] for axis in ("x_mm", "y_mm", "z_mm")]
        assert np.linalg.norm(place - truth.at([there]).translation[0]) < 1.0


def test_a_camera_that_falls_out_is_red_at_once_and_comes_back(still, tmp_path):
    """And one that was never there holds up no other."""
    camera = HostileCamera(pictures(still, 0), period_s=0.1)
    stall = next(fault for fault in FAULTS if fault.name == "stall")
    away = "!!document.querySelector('[data-camera=cam0].away')"
    with hostile([camera]) as found, Chromium(420, 800, dark=True) as page:
        (address,) = found
        words = (f"cam0={address}", "cam1=http://127.0.0.1:1/x")
        with studio(tmp_path, *words) as url:
            page.open(url)
            page.wait_for(f"!{away} && {SHOWN.format(1)}", 30)
            page.wait_for(STATE.format("cam1", "Connection refused"), 20)
            camera.fault = stall
            page.wait_for(away, 5)
            camera.fault = None
            page.wait_for(f"!{away}", 30)
            width = page.evaluate("document.documentElement.scrollWidth")
            assert width <= 420


def test_what_cannot_be_served_is_refused_in_one_line(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["studio", str(tmp_path), "--port", port, "--no-browser"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"127.0.0.1, port {port}: nothing can listen there" in line
    outside = tmp_path / "outside.mp4"
    outside.touch()
    command = ["studio", str(tmp_path / "desk"), f"cam0={outside}", "--port", "0", "--no-browser"]
    assert main(command) == 2
    assert "lies outside" in capsys.readouterr().err

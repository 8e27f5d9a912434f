"""In a browser: cameras fall out and come back; and what cannot be served is refused."""

from __future__ import annotations

import socket

import cv2
import numpy as np
import pytest

from benchmarks.faults.cameras import FAULTS
from benchmarks.faults.hostile_camera import HostileCamera, hostile
from measure.cli import main
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.studio.desk import fill, go, press, strike, studio

pytestmark = [pytest.mark.browser, pytest.mark.slow]
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length == {}"
STATE = "document.querySelector('[data-camera={}]')?.innerText.includes('{}')"


def pictures(rng):
    noise = rng.integers(0, 255, (4, 240, 320, 3), dtype=np.uint8)
    return [cv2.imencode(".jpg", pixels)[1].tobytes() for pixels in noise]


def test_a_camera_that_falls_out_is_red_at_once_and_comes_back(rng, tmp_path):
    """And one that was never there holds up no other."""
    camera = HostileCamera(pictures(rng), period_s=0.1)
    stall = next(fault for fault in FAULTS if fault.name == "stall")
    away = "!!document.querySelector('[data-camera=cam0].away')"
    with hostile([camera]) as found, Chromium(420, 800, dark=True) as page:
        (address,) = found
        words = (f"cam0={address}", "cam1=http://127.0.0.1:1/x")
        with studio(tmp_path, *words) as url:
            go(page, url)
            page.wait_for(f"!{away} && {SHOWN.format(1)}", 30)
            page.wait_for(STATE.format("cam1", "Connection refused"), 20)
            camera.fault = stall
            page.wait_for(away, 5)
            camera.fault = None
            page.wait_for(f"!{away}", 30)
            width = page.evaluate("document.documentElement.scrollWidth")
            assert width <= 420


def test_a_typo_is_no_camera_and_people_name_cameras(rng, tmp_path):
    """Each address is tried first; a camera is taken away only after a question."""
    cameras = "document.querySelectorAll('[data-camera]').length == {}"
    said = "document.body.innerText.includes({!r})"
    known = tmp_path / "cameras.txt"
    with (
        serving({"cam0": ServedCamera(pictures(rng), 0.1)}) as found,
        Chromium(390, 840) as page,
        studio(tmp_path) as url,
    ):
        address = found["cam0"]
        go(page, url)
        for typo, refusal in (
            ("http://127.0.0.1:1/x", "cam0 was not added: "),
            ("x" * 300 + "=" + address, "a camera's name"),
        ):
            fill(page, "Camera", typo)
            strike(page, "Enter", "\r")
            page.wait_for(said.format(refusal), 20)
            assert page.evaluate(cameras.format(0))
            assert known.read_text("utf-8") == ""
        for name in ("käm links", "k" * 200):
            fill(page, "Camera", f"{name}={address}")
            strike(page, "Enter", "\r")
            page.wait_for(said.format(name), 20)
        kept = known.read_text("utf-8")
        assert kept == "".join(f"{n}={address}\n" for n in ("käm links", "k" * 200))
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.evaluate("document.querySelector('[aria-label=\"remove käm links\"]').click()")
        press(page, "keep it")
        page.idle(0.6)
        assert page.evaluate(cameras.format(2))
        page.evaluate("document.querySelector('[aria-label=\"remove käm links\"]').click()")
        press(page, "take it away")
        page.wait_for(cameras.format(1), 20)
        assert "käm" not in known.read_text("utf-8")
        press(page, "find cameras of")
        page.wait_for(said.format("at this computer"), 20)


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

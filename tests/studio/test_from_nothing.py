"""In a browser: from an empty folder to believed poses, through every step."""

from __future__ import annotations

import csv
import re
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.geometry import RigidTransform
from measure.results import read_run
from measure.session import read_body, read_calibration
from measure.simulation.catalogue import WORKSPACE_MM, webcam_scene
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.simulated.sessions import rendered
from tests.studio import desk, waved

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]
ADVICE = "document.querySelector('[data-advice]')?.innerText"
JUDGEMENT = "document.querySelector('[data-judgement]')?.innerText"
FIGURES = "document.querySelector('[data-body]')?.innerText ?? ''"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length == {}"
SETTLED = 8  # Pictures
PERIOD_S, AT_REST_S = 0.3, 0.1
"""Pictures of one instant are told apart from the next ones on a busy machine, too."""
MOST_PRESSES, MOST_TYPED, MOST_WAITING_S = 12, 60, 240.0
PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "set_up_in_the_browser.md"


class CHARUCO:
    """A board that is waved, at instants that fill all parts of both pictures, near and far."""

    POSES_S = (20.8, 170.0, 144.8, 138.4, 9.2, 73.2, 6.4, 14.8, 30.0, 41.0, 52.0, 60.0)

    @classmethod
    def poses(cls):
        """world_from_board, each pose twice: out of step, cameras take the second."""
        return [waved.waved(t) for t in np.repeat(cls.POSES_S, 2)]

    @classmethod
    def pictures(cls, rng, rig):
        """What cameras see of them."""
        return {c.name: [jpeg(waved.picture(c, p, rng)) for p in cls.poses()] for c in rig}


def cameras(azimuths_deg=(60, 120)):
    """Those before which the board is waved, where the workspace is."""
    up, rig = RigidTransform(np.eye(3), WORKSPACE_MM), waved.rig(azimuths_deg)
    return tuple(replace(c, world_from_camera=up @ c.world_from_camera) for c in rig)


def jpeg(pixels):
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def ball_pictures():
    """Of the paper's body while it is turned."""
    folder = rendered(replace(webcam_scene(), cameras=cameras()), np.arange(8) / 20)
    return {
        c.name: [file.read_bytes() for file in sorted((folder / c.name).glob("*.jpg"))]
        for c in cameras()
    }


def at_rest(picture, rng):
    """Pictures of what does not move differ by their noise, or the camera stalls."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    noisy = (pixels + rng.normal(0, 1.5, pixels.shape) for _ in range(6))
    return [jpeg(np.clip(np.rint(one), 0, 255).astype(np.uint8)) for one in noisy]


def test_from_an_empty_folder_to_believed_poses(tmp_path, rng):
    home, balls = tmp_path / "desk", ball_pictures()
    boards = CHARUCO.pictures(rng, waved.rig())
    served = {n: ServedCamera(some, PERIOD_S, stamps=True) for n, some in boards.items()}
    with serving(served) as addresses, desk.studio(home) as address, Chromium(1440, 900) as page:
        waits = Waits()
        desk.go(page, address)
        page.wait_for(desk.ONE_PRIMARY, 20)
        add_cameras(page, addresses)
        desk.go_on(page, "Calibration")
        wave_the_board(page, waits)
        serve(served, {n: at_rest(some[0], rng) for n, some in boards.items()})
        check_pair(home, 1.5, 0.3)
        desk.go_on(page, "World")
        put_the_world_at_the_board(page, waits)
        serve(served, balls)
        desk.go_on(page, "Body")
        make_the_body(page, waits)
        check_body(home)
        serve(served, {n: at_rest(some[0], rng) for n, some in balls.items()}, AT_REST_S)
        desk.go_on(page, "Measure")
        measure(page, waits)
        check_steps(page, waits)
        mark_an_event(page)
        assert page.errors == []
        assert [r for r in page.requests if not r.startswith((address, "blob:", "data:"))] == []
        check_served_files(address)
    check_run(home, addresses)


class Waits(dict[str, float]):
    """How long each part of the way took, in seconds."""

    def note(self, page, what, expression, timeout_s):
        """Wait for something, and note how long it took."""
        begun_s = time.monotonic()
        page.wait_for(expression, timeout_s)
        self[what] = time.monotonic() - begun_s


def serve(served, pictures, period_s=PERIOD_S):
    """Other pictures; on return those before have passed: no hand moves a board faster."""
    sent = {one: len(served[one].taken_s) for one in served}
    for name, some in pictures.items():
        served[name].pictures, served[name].period_s = some, period_s
    until_s = time.monotonic() + 10
    while time.monotonic() < until_s and any(
        len(served[one].taken_s) < before + SETTLED for one, before in sent.items()
    ):
        time.sleep(0.05)


def add_cameras(page, addresses):
    """All at once, by a range in the address, as it is typed for two as for four."""
    desk.count(page)  # The field is clicked
    first, last = addresses.values()
    both = first.replace("/cam0", "/cam[0-1]")
    assert last == first.replace("/cam0", "/cam1")
    desk.fill(page, "Camera", both)
    desk.count(page, 0, len(both))
    desk.strike(page, "Enter", "\r")
    page.wait_for(SHOWN.format(2), 30)
    for fact in ("640 x 480 px", "its own clock"):
        page.wait_for(f"document.body.innerText.includes('{fact}')", 20)
    page.wait_for(desk.is_done("Cameras"), 20)


def wave_the_board(page, waits):
    """Advice comes till nothing is missing; then the cameras are calibrated without a click."""
    desk.press(page, "wave the board")
    page.wait_for(f"/cam/.test({ADVICE})", 30)
    page.wait_for("document.querySelectorAll('.over circle.corner').length > 6", 30)
    waits.note(page, "waving", f"{desk.FOOT}.includes('calibrating') || {JUDGEMENT}", 240)
    waits.note(page, "calibrating", f"/The cameras are calibrated/.test({JUDGEMENT})", 120)
    page.wait_for(desk.is_done("Calibration"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)


def put_the_world_at_the_board(page, waits):
    """It is at rest by now, where both cameras see it."""
    page.wait_for("document.body.innerText.includes('The board is seen')", 30)
    assert page.evaluate(f"!{desk.is_done('World')}")
    desk.press(page, "set the origin")
    waits.note(page, "world", desk.is_done("World"), 30)
    page.wait_for("document.querySelectorAll('.over path.axis.z').length >= 2", 20)


def make_the_body(page, waits):
    """Balls of the paper's colours need no click: a recording says where they are on the body."""
    page.wait_for(SHOWN.format(2), 30)
    desk.press(page, "record and measure")
    waits.note(page, "body", f"/body-1.*3 balls/.test({desk.FOOT})", 240)
    page.wait_for(f"/red - green|green - red/.test({FIGURES})", 20)
    page.wait_for(desk.is_done("Body"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)


def measure(page, waits):
    desk.press(page, "measure$")
    first = "document.querySelector('[data-pose]')?.innerText.includes('±')"
    waits.note(page, "first pose", first, 90)


def mark_an_event(page):
    """And stop."""
    desk.strike(page, "m", "m")
    page.wait_for("document.querySelector('[data-events]').innerText.includes('1. event')", 20)
    page.idle(1.0)
    desk.press(page, "stop")
    page.wait_for("/STOPPED[^]*poses good/.test(document.body.innerText)", 90)
    page.wait_for("!!document.querySelector('a[href$=\"run-1/report.html\"]')", 20)
    page.wait_for(desk.is_done("Measure"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)
    assert page.evaluate("document.querySelector('[data-help]').hash") == "#measure"


def check_steps(page, waits):
    """The tables in the docs are of the steps that were made here, and of the commands there."""
    titles = ("Cameras", "Calibration", "World", "Body", "Measure")
    made = {title: [page.steps[title, kind] for kind in ("clicks", "typed")] for title in titles}
    made["in all"] = [sum(row) for row in zip(*made.values(), strict=True)]
    print(made["in all"], {what: f"{s:.0f} s" for what, s in waits.items()})
    assert made["in all"][0] <= MOST_PRESSES
    assert made["in all"][1] <= MOST_TYPED
    assert sum(waits.values()) < MOST_WAITING_S
    text = PAGE.read_text("utf-8")
    (commands,) = re.findall(r"<!-- all by commands -->\n```text\n(.*?)```", text, re.S)
    rows = re.findall(r"^\| (.+?) \| (\d+) \| (\d+) \|$", text, re.M)
    made["by commands"] = [0, len(commands)]
    assert {title: [int(clicks), int(typed)] for title, clicks, typed in rows} == made


def check_pair(home, mm, deg):
    """The second camera is where it is from the first."""
    true, found = cameras(), read_calibration(home / "calibration.toml").cameras
    for one, there in zip(found, true, strict=True):
        assert one.intrinsics.focal_px == pytest.approx(there.intrinsics.focal_px, rel=0.01)
    ways = [a.world_from_camera.inverse() @ b.world_from_camera for a, b in (found, true)]
    assert np.linalg.norm(ways[0].translation - ways[1].translation) < mm
    assert np.degrees(np.linalg.norm((ways[0] @ ways[1].inverse()).rotvec)) < deg


def check_body(home):
    found, true = read_body(home / "body-1.toml"), webcam_scene().body
    for pair, length in true.distances().items():
        sides = found.distances()
        assert sides.get(pair, sides.get(pair[::-1])) == pytest.approx(length, abs=0.4)


def check_served_files(address):
    report = urllib.request.urlopen(f"{address}file/run-1/report.html").read()
    assert b"<html" in report[:200].lower()
    for elsewhere in ("%2e%2e/secret.csv", "/etc/hosts.csv", "run-1/run.toml", "no.html"):
        with pytest.raises(urllib.error.HTTPError, match=r"403|404"):
            urllib.request.urlopen(f"{address}file/{elsewhere}")


def check_run(home, addresses):
    """The balls rest where they are in the board's frame, whose z points out of the paper."""
    assert (home / "cameras.txt").read_text() == "".join(f"{n}={a}\n" for n, a in addresses.items())
    run = read_run(home / "run-1")
    assert run.finished
    assert run.session.parent.parent == home
    with (home / "run-1" / "events.csv").open() as file:
        (event,) = csv.DictReader(file)
    assert run.times_s[0] < float(event["time_s"]) < run.times_s[-1] + 1
    poses = run.world_from_body[run.unflagged[run.has_pose]]
    assert len(poses.translation) >= 2
    scene, body = webcam_scene(), read_body(home / "body-1.toml")
    up = RigidTransform(np.diag([1.0, -1, -1]), np.zeros(3))
    world = RigidTransform(np.eye(3), WORKSPACE_MM) @ CHARUCO.poses()[0] @ up
    resting = scene.trajectory.at(np.zeros(1))
    for name in scene.body.names:
        true = resting.apply(scene.body.centers[scene.body.index(name)][None])
        found = poses.apply(body.centers[body.index(name)][None])
        assert np.linalg.norm(found - world.inverse().apply(true), axis=-1).max() < 1.5

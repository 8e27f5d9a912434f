"""In a browser: from an empty folder to a measured run, through every page."""

from __future__ import annotations

import csv
import re
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.api import shipped_targets
from measure.calibration.targets import read_markers
from measure.geometry import RigidTransform
from measure.results import read_run
from measure.session import read_body, read_calibration
from measure.simulation import write_session
from measure.simulation.catalogue import WORKSPACE_MM, webcam_scene
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium, find_chromium
from tests.studio import waved
from tests.studio.desk import (
    FOOT,
    choose,
    click_at,
    count,
    fill,
    go,
    press,
    strike,
    studio,
    turn_to,
)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(find_chromium() is None, reason="no chromium on this machine"),
]
ADVICE = "document.querySelector('[data-advice]')?.innerText"
FIGURES = "document.querySelector('[data-body]')?.innerText ?? ''"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length == {}"
PERIOD_S, AT_REST_S = 0.3, 0.1
"""Pictures of one instant are told apart from the next ones on a busy machine, too."""
PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "set_up_in_the_browser.md"
GOAL_MM = 1.0  # The board has twelve poses alone
POSES_S = (20.8, 170.0, 144.8, 138.4, 9.2, 73.2, 6.4, 14.8, 30.0, 41.0, 52.0, 60.0)
"""Of the waved board: the first eight fill all parts of both pictures, tilted, near and far."""
FIELD = read_markers(shipped_targets()["raven_markers_16"])


def cameras():
    """Those before which the board is waved, where the workspace is."""
    up = RigidTransform(np.eye(3), WORKSPACE_MM)
    return tuple(replace(c, world_from_camera=up @ c.world_from_camera) for c in waved.rig())


def jpeg(pixels):
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def board_pictures(rng):
    """Each pose twice: out of step, cameras take the second."""
    poses = [waved.waved(t) for t in np.repeat(POSES_S, 2)]
    return {c.name: [jpeg(waved.picture(c, p, rng)) for p in poses] for c in waved.rig()}


def ball_pictures(folder):
    """Of the paper's body while it is turned."""
    scene = replace(webcam_scene(), cameras=cameras())
    write_session(scene, np.arange(8) / 20, folder)
    return {
        c.name: [file.read_bytes() for file in sorted((folder / c.name).glob("*.jpg"))]
        for c in cameras()
    }


def at_rest(picture, rng):
    """Pictures of what does not move differ by their noise, or the camera stalls."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    noisy = (pixels + rng.normal(0, 1.5, pixels.shape) for _ in range(6))
    return [jpeg(np.clip(np.rint(one), 0, 255).astype(np.uint8)) for one in noisy]


def test_from_an_empty_folder_to_a_measured_run(tmp_path, rng):
    desk, balls, boards = tmp_path / "desk", ball_pictures(tmp_path / "balls"), board_pictures(rng)
    served = {n: ServedCamera(some, PERIOD_S, stamps=True) for n, some in boards.items()}
    with serving(served) as addresses, studio(desk) as address, Chromium(1280, 800) as page:
        go(page, address)
        add_cameras(page, addresses)
        turn_to(page, "Calibration")
        wave_the_board(page)
        serve(served, {n: at_rest(some[0], rng) for n, some in boards.items()})
        calibrate_by_the_board_as_it_lies(page)
        true = check_pair(desk, 1.5, 0.3)
        serve(served, {c.name: [jpeg(waved.dots(c, FIELD.points))] for c in true})
        turn_to(page, "Marks")
        mark_the_dots(page, true)
        check_places(desk, true)
        serve(served, balls)
        turn_to(page, "Body")
        make_the_body(page, desk, true, tmp_path / "balls")
        check_body(desk)
        resting = {name: at_rest(pictures[0], rng) for name, pictures in balls.items()}
        serve(served, resting, AT_REST_S)
        put_the_world_at_the_body(page, address)
        turn_to(page, "Measure")
        measure(page)
        assert page.errors == []
        assert [r for r in page.requests if not r.startswith((address, "blob:", "data:"))] == []
        check_served_files(address)
    check_run(desk, addresses)


def serve(served, pictures, period_s=PERIOD_S):
    for name, some in pictures.items():
        served[name].pictures, served[name].period_s = some, period_s


def as_if_four(page, before):
    """Count what was done for the second of two cameras for two further ones, too."""
    second = page.steps - before
    page.steps += second + second


def add_cameras(page, addresses):
    count(page)  # The field is clicked once, and keeps the cursor
    for name, stream in addresses.items():
        before = page.steps.copy()
        fill(page, "Camera", stream)
        count(page, 0, len(stream))
        strike(page, "Enter", "\r")
        page.wait_for(f"!!document.querySelector('[data-camera={name}]')", 20)
    as_if_four(page, before)
    page.wait_for(SHOWN.format(2), 30)
    for fact in ("640 x 480 px", "its own clock"):
        page.wait_for(f"document.body.innerText.includes('{fact}')", 20)


def wave_the_board(page):
    """Advice comes till nothing is missing."""
    press(page, "draw it")
    page.wait_for(f"!!document.querySelector('a[href$=\"{waved.TARGET}.pdf\"]')", 20)
    count(page)  # The link to it
    fill(page, "Goal at the body, mm", f"{GOAL_MM:g}")
    press(page, "wave the board")
    page.wait_for(f"{ADVICE}.includes('cam')", 30)
    page.wait_for(f"/capture-1: .*good enough/.test({FOOT})", 120)
    assert page.evaluate(ADVICE) == "enough"


def calibrate_by_the_board_as_it_lies(page):
    """It is at rest by now, where both cameras see it."""
    press(page, "calibrate$")
    page.wait_for("!!document.querySelector('a[href$=\"calibration.html\"]')", 120)
    judgement = "document.querySelector('[data-judgement]').innerText"
    page.wait_for(f"{judgement}.includes('expected body position error')", 20)
    press(page, "world: the board")
    page.wait_for(f"{FOOT}.includes('the world is the board')", 20)


def mark_the_dots(page, true):
    """Some are clicked, a little beside; the others are proposed, at their places."""
    choose(page, "Markers of", "raven_markers_16")
    press(page, "open$")
    page.wait_for("!!document.querySelector('.marked img')", 20)
    for camera in true:
        before = page.steps.copy()
        press(page, f"{camera.name}$")
        page.wait_for(f"document.querySelector('.marked img').src.includes('{camera.name}')", 20)
        at = camera.project(FIELD.points)
        inside = np.flatnonzero(camera.intrinsics.contains(at, 25.0))
        for k in inside[:: len(inside) // 4][:4]:
            name, rows = FIELD.names[k], "[...document.querySelectorAll('[data-marks] tr')]"
            row = f"{rows}.find(r => r.innerText.startsWith('{name}'))"
            page.wait_for(f"!!{row}", 10)
            page.evaluate(f"{row}.click()")
            page.wait_for(
                f"document.querySelector('input[aria-label=Marker]').value == '{name}'", 10
            )
            click_at(page, ".marked img", *(at[k] + [1.6, -1.2]))
            page.wait_for(f"/radius/.test({row}.innerText)", 10)
            count(page, 2)
        press(page, "find$")
        page.wait_for(f"document.querySelectorAll('circle.mark').length >= {len(inside) - 2}", 20)
    as_if_four(page, before)
    press(page, "write marks")
    page.wait_for("document.body.innerText.includes('marks-1/marks.csv is written')", 20)
    press(page, "locate the cameras")
    page.wait_for(f"/marks-1 gave calibration.toml/.test({FOOT})", 60)


def make_the_body(page, desk, true, session):
    """One ball is clicked, all are found; a recording says where they are on the body."""
    choose(page, "Ball to click", "red")
    page.wait_for(SHOWN.format(2), 30)
    truth = read_body(session / "body.toml")
    motion = webcam_scene().trajectory.at(np.arange(8) / 20)
    place = motion.apply(truth.centers[truth.index("red")])
    u, v = np.mean(true[0].project(place.reshape(-1, 3)), axis=0)
    colors = desk / "colours.toml"

    def is_picked():
        """A picture of before, which may still be shown, has no ball there."""
        click_at(page, "img.live", u, v)
        page.idle(1.0)
        return colors.exists()

    page.wait_until(is_picked, "a ball is clicked", 60)
    count(page)
    for name in ("cam0", "cam1"):
        page.wait_for(f"document.body.innerText.includes('{name}: green, red, yellow')", 240)
    press(page, "record and measure the body")
    page.wait_for(f"/body-1.toml: 3 balls/.test({FOOT})", 240)
    page.wait_for(f"/green - red/.test({FIGURES})", 20)


def measure(page):
    press(page, "measure$")
    page.wait_for("document.querySelector('[data-pose]')?.innerText.includes('±')", 90)
    check_steps(page)
    strike(page, "m", "m")
    page.wait_for("document.querySelector('[data-events]').innerText.includes('1. event')", 20)
    page.idle(1.0)
    press(page, "stop")
    page.wait_for(f"/run-1: .* believed/.test({FOOT})", 90)
    page.wait_for("!!document.querySelector('a[href$=\"run-1/report.html\"]')", 20)


def put_the_world_at_the_body(page, address):
    """Another way to a world, which nobody counts."""
    go(page, address + "calibration")
    steps = page.steps.copy()
    choose(page, "Body to be measured", "body-1.toml")
    press(page, "world: the body at rest")
    page.wait_for(f"{FOOT}.includes('the world is the frame of body-1.toml')", 60)
    page.steps = steps


def check_steps(page):
    """The tables in the docs are of the steps that were made here, and of the commands there."""
    text = PAGE.read_text("utf-8")
    (commands,) = re.findall(r"<!-- all by commands -->\n```text\n(.*?)```", text, re.S)
    rows = re.findall(r"^\| (.+?) \| (\d+) \| (\d+) \|$", text, re.M)
    titles = ("Cameras", "Calibration", "Marks", "Body", "Measure")
    made = {title: [page.steps[title, kind] for kind in ("clicks", "typed")] for title in titles}
    used = [made[title] for title in titles if title != "Marks"]
    made["in all, without Marks"] = [sum(row) for row in zip(*used, strict=True)]
    made["by commands"] = [0, len(commands)]
    assert {title: [int(clicks), int(typed)] for title, clicks, typed in rows} == made


def check_pair(desk, mm, deg):
    """The second camera is where it is from the first, and the world is the board's; the truth."""
    true, found = cameras(), read_calibration(desk / "calibration.toml").cameras
    for one, there in zip(found, true, strict=True):
        assert one.intrinsics.focal_px == pytest.approx(there.intrinsics.focal_px, rel=0.01)
        assert one.center[2] > 100  # seen from the cameras' side, z up from the paper
    ways = [a.world_from_camera.inverse() @ b.world_from_camera for a, b in (found, true)]
    assert np.linalg.norm(ways[0].translation - ways[1].translation) < mm
    assert np.degrees(np.linalg.norm((ways[0] @ ways[1].inverse()).rotvec)) < deg
    return true


def check_places(desk, true):
    for one, there in zip(read_calibration(desk / "calibration.toml").cameras, true, strict=True):
        assert np.linalg.norm(one.center - there.center) < 2.0


def check_body(desk):
    found, true = read_body(desk / "body-1.toml"), webcam_scene().body
    for pair, length in true.distances().items():
        sides = found.distances()
        assert sides.get(pair, sides.get(pair[::-1])) == pytest.approx(length, abs=0.4)


def check_served_files(address):
    report = urllib.request.urlopen(f"{address}file/run-1/report.html").read()
    assert b"<html" in report[:200].lower()
    for elsewhere in ("%2e%2e/secret.csv", "/etc/hosts.csv", "run-1/run.toml", "no.html"):
        with pytest.raises(urllib.error.HTTPError, match=r"403|404"):
            urllib.request.urlopen(f"{address}file/{elsewhere}")


def check_run(desk, addresses):
    """The body still rests where the world was put: its pose there is none."""
    assert (desk / "cameras.txt").read_text() == "".join(f"{n}={a}\n" for n, a in addresses.items())
    run = read_run(desk / "run-1")
    assert run.finished
    assert run.session.parent.parent == desk
    with (desk / "run-1" / "events.csv").open() as file:
        (event,) = csv.DictReader(file)
    assert run.times_s[0] < float(event["time_s"]) < run.times_s[-1] + 1
    poses = run.poses.filter(run.has_pose).to_pylist()
    assert len(poses) >= 2
    for pose in poses:
        assert np.linalg.norm([pose[axis] for axis in ("x_mm", "y_mm", "z_mm")]) < GOAL_MM

"""In a browser: an object of one's own, from an empty folder to believed poses.

Through every step, with both boards; each last change is taken back once.
"""

from __future__ import annotations

import csv
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from measure.calibration import Charuco, Chessboard
from measure.geometry import RigidTransform
from measure.results import read_run
from measure.session import read_body, read_calibration
from measure.simulation.catalogue import WORKSPACE_MM, shaft, stems, webcam_scene
from measure_studio.page.layout import WIDTH_PX
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.simulated.catalogue import body
from tests.simulated.sessions import rendered
from tests.studio import desk, waved

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]
ADVICE = "document.querySelector('[data-advice]')?.innerText"
JUDGEMENT = "document.querySelector('[data-judgement]')?.innerText"
FIGURES = "document.querySelector('[data-body]')?.innerText ?? ''"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length == {}"
SETTLED = 5  # Pictures
PERIOD_S, AT_REST_S = 0.3, 0.1
"""Pictures of one instant are told apart from the next ones on a busy machine, too."""
MOST_PRESSES, MOST_TYPED, MOST_WAITING_S = 12, 60, 400.0
PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "set_up_in_the_browser.md"
AZIMUTHS_DEG = (60.0, 90.0, 120.0)
MAGENTA = "pink"  # As the program calls it
CHIPS = "document.querySelectorAll('[data-ball]{}').length"
WATCH_SIZES = """window.sizes = [];
setInterval(() => sizes.push(document.querySelector('img.live').naturalWidth), 2); true"""
"""JavaScript: a picture without a size, while the next one takes its place, hears no click."""


@dataclass(frozen=True)
class Waved:
    """A board that is waved, at instants that differ much."""

    board: Callable[[], Charuco | Chessboard]
    poses_s: tuple[float, ...]

    def poses(self):
        """world_from_board."""
        return [waved.waved(t, self.board()) for t in self.poses_s]

    def pictures(self, rng, rig):
        """What cameras see of them; each pose is held, for a busy machine looks seldom."""
        board, poses = self.board(), self.poses()
        return {
            c.name: [one for p in poses for one in noisy(waved.picture(c, p, rng, board), rng, 3)]
            for c in rig
        }


CHARUCO = Waved(waved.board, (20.8, 170.0, 144.8, 138.4, 9.2, 73.2, 41.0, 14.8, 30.0))
PLAIN = Waved(waved.plain_board, (181.6, 46.8))


def cameras(azimuths_deg=AZIMUTHS_DEG):
    """Those before which the board is waved, where the workspace is."""
    up, rig = RigidTransform(np.eye(3), WORKSPACE_MM), waved.rig(azimuths_deg)
    return tuple(replace(c, world_from_camera=up @ c.world_from_camera) for c in rig)


def jpeg(pixels):
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()


def own_object():
    """An object with four balls of other colours than the paper's, and how it is turned."""
    places = {
        "white": (34.0, 6.0, -4.0),
        "blue": (-8.0, 33.0, 6.0),
        "orange": (-31.0, -9.0, -6.0),
        "magenta": (6.0, -30.0, 14.0),
    }
    own = body("my object", places, 15.0)
    attached = (*stems(own), shaft(color=(0.02,) * 3))
    return replace(webcam_scene(), name="own", body=own, cameras=cameras(), attached=attached)


def ball_pictures():
    """Of the object while it is turned."""
    folder = rendered(own_object(), PERIOD_S * np.arange(10))
    return {
        c.name: [file.read_bytes() for file in sorted((folder / c.name).glob("*.jpg"))]
        for c in cameras()
    }


def noisy(pixels, rng, count):
    """Pictures of what does not move differ by their noise, or the camera stalls."""
    some = (pixels + rng.normal(0, 1.5, pixels.shape) for _ in range(count))
    return [jpeg(np.clip(np.rint(one), 0, 255).astype(np.uint8)) for one in some]


def at_rest(picture, rng):
    """What is seen of the same scene from now on."""
    pixels = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    return noisy(pixels, rng, 6)


def test_from_an_empty_folder_to_believed_poses(tmp_path, rng):
    home, balls, rig = tmp_path / "desk", ball_pictures(), waved.rig(AZIMUTHS_DEG)
    boards = CHARUCO.pictures(rng, rig)
    served = {n: ServedCamera(some, PERIOD_S, stamps=True) for n, some in boards.items()}
    with serving(served) as addresses, desk.studio(home) as address, Chromium(1440, 900) as page:
        waits = Waits()
        desk.go(page, address)
        page.wait_for(desk.ONE_PRIMARY, 20)
        add_cameras(page, addresses)
        desk.go_on(page, "Calibration")
        wave_the_board(page, waits)
        serve(served, {n: at_rest(some[0], rng) for n, some in boards.items()})
        check_rig(home, 1.5, 0.3)
        desk.go_on(page, "World")
        put_the_world_at_the_board(page, home, waits)
        serve(served, {n: at_rest(some[0], rng) for n, some in balls.items()})
        desk.go_on(page, "Body")
        click_balls(page, home)
        serve(served, balls)
        make_the_body(page, waits)
        check_body(home)
        rename_and_take_back(page, home)
        serve(served, {n: at_rest(some[0], rng) for n, some in balls.items()}, AT_REST_S)
        desk.go_on(page, "Measure")
        measure(page, waits)
        check_steps(page, waits)
        mark_an_event(page)
        assert [r for r in page.requests if not r.startswith((address, "blob:", "data:"))] == []
        check_served_files(address)
        check_run(home, addresses)
        look_through_recordings(page, address, home)
        serve(served, PLAIN.pictures(rng, rig))
        take_the_board_that_is_seen(page, address, home)
        assert page.errors == []


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
    first, *_, last = addresses.values()
    every = first.replace("/cam0", "/cam[0-2]")
    assert last == first.replace("/cam0", "/cam2")
    desk.fill(page, "Camera", every)
    desk.count(page, 0, len(every))
    desk.strike(page, "Enter", "\r")
    page.wait_for(SHOWN.format(3), 30)
    for fact in ("640 x 480 px", "its own clock"):
        page.wait_for(f"document.body.innerText.includes('{fact}')", 20)
    page.wait_for(desk.is_done("Cameras"), 20)


def wave_the_board(page, waits):
    """Advice comes till nothing is missing; then the cameras are calibrated without a click."""
    desk.press(page, "wave the board")
    page.wait_for(f"/cam/.test({ADVICE})", 30)
    waits.note(page, "waving", f"{desk.FOOT}.includes('calibrating') || {JUDGEMENT}", 240)
    waits.note(page, "calibrating", f"/The cameras are calibrated/.test({JUDGEMENT})", 120)
    page.wait_for(desk.is_done("Calibration"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)


def put_the_world_at_the_board(page, home, waits):
    """It is at rest by now, where all cameras see it; taken back, and that taken back, too."""
    file = home / "calibration.toml"
    first = file.read_bytes()
    page.wait_for("document.body.innerText.includes('The board is seen')", 30)
    assert page.evaluate(f"!{desk.is_done('World')}")
    desk.press(page, "set the origin")
    waits.note(page, "world", desk.is_done("World"), 30)
    page.wait_for("document.querySelectorAll('.over path.axis.z').length >= 2", 20)
    second = file.read_bytes()
    assert second != first
    for there in (first, second):
        press_in(page, "document", "take back the world")
        page.wait_until(lambda held=there: file.read_bytes() == held, "taken back", 20)


def click_balls(page, home):
    """All were found; the ground teaches nothing, and pictures stay where they are."""
    page.wait_for(SHOWN.format(3), 60)
    page.wait_for(f"{CHIPS.format('')} == 4", 120)
    top = "document.querySelector('img.live').getBoundingClientRect().top + scrollY"
    before = page.evaluate(top)
    page.evaluate(WATCH_SIZES)
    page.evaluate("window.chip = document.querySelector('[data-ball=blue]'); true")
    desk.click_at(page, "img.live", 20, 20)
    page.wait_for("document.body.innerText.includes('no ball-like patch')", 20)
    assert not (home / "colours.toml").exists()
    scene = own_object()
    pose = scene.trajectory.at(np.zeros(1))
    center = pose.apply(scene.body.centers[scene.body.index("blue")][None])
    at = np.ravel(scene.cameras[0].project(center.reshape(1, 3)))
    scale = min(1.0, WIDTH_PX / scene.cameras[0].intrinsics.size_wh[0])
    desk.click_at(page, "img.live", *(scale * (at + 0.5) - 0.5))
    page.wait_until((home / "colours.toml").exists, "blue is learnt", 20)
    page.wait_for("/learnt/.test(document.querySelector('[data-ball=blue]').innerText)", 20)
    assert page.evaluate(top) == before
    assert page.evaluate("chip.isConnected")  # Or a name that is typed meanwhile would be lost
    page.wait_for("sizes.length > 500", 60)
    assert page.evaluate("sizes.filter((width) => !width).length") == 0


def make_the_body(page, waits):
    """No colour is chosen: a recording says where the balls are on the body."""
    desk.count(page, 1, 2)  # The field is clicked
    desk.fill(page, "Radius of the balls, mm", "15")
    desk.fill(page, "Seconds", "4")
    desk.press(page, "record and measure")
    waits.note(page, "body", f"/body-1.*4 balls/.test({desk.FOOT})", 240)
    page.wait_for(f"{CHIPS.format('.sure')} == 4", 20)
    page.wait_for(f"/blue - white|white - blue/.test({FIGURES})", 20)
    page.wait_for(desk.is_done("Body"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)


def rename_and_take_back(page, home):
    """The name in the list is that in the file."""
    name = "document.querySelector('[data-ball=white] input').value"
    desk.fill(page, "name of the white ball", "tip")
    page.evaluate("document.activeElement.blur()")
    text = (home / "body-1.toml").read_text  # read while it may be being written
    page.wait_until(lambda: 'name = "tip"' in text(), "named", 20)
    press_in(page, "document", "take back the name")
    page.wait_until(lambda: 'name = "white"' in text(), "taken back", 20)
    page.wait_for(f"{name} == 'white'", 20)
    assert page.evaluate(f"{CHIPS.format('.sure')} == 4")


def measure(page, waits):
    desk.press(page, "measure$")
    first = "document.querySelector('[data-pose]')?.innerText.includes('±')"
    waits.note(page, "first pose", first, 90)


def mark_an_event(page):
    """And stop, by the space bar, though the button that began it has the focus."""
    desk.strike(page, "m", "m")
    page.wait_for("document.querySelector('[data-events]').innerText.includes('1. event')", 20)
    page.idle(1.0)
    desk.strike(page, " ", " ")
    page.wait_for("/STOPPED[^]*poses good/.test(document.body.innerText)", 90)
    page.wait_for("!!document.querySelector('.poses.old .age')", 20)
    page.wait_for("!!document.querySelector('a[href$=\"run-1/report.html\"]')", 20)
    page.wait_for(desk.is_done("Measure"), 20)
    page.wait_for(desk.ONE_PRIMARY, 20)
    assert page.evaluate("document.querySelector('[data-help]').hash") == "#measure"


def check_steps(page, waits):
    """The counts in the docs are of the steps that were made here, and of the commands there."""
    titles = ("Cameras", "Calibration", "World", "Body", "Measure")
    made = {title: [page.steps[title, kind] for kind in ("clicks", "typed")] for title in titles}
    made["in all"] = [sum(row) for row in zip(*made.values(), strict=True)]
    print(made["in all"], {what: f"{s:.0f} s" for what, s in waits.items()})
    assert made["in all"][0] <= MOST_PRESSES
    assert made["in all"][1] <= MOST_TYPED
    assert sum(waits.values()) < MOST_WAITING_S
    text = PAGE.read_text("utf-8")
    (commands,) = re.findall(r"<!-- all by commands -->\n```text\n(.*?)```", text, re.S)
    stated = re.findall(r"(\d+) clicks and (\d+) typed|commands takes (\d+) characters", text)
    assert [int(n) for row in stated for n in row if n] == [*made["in all"], len(commands)]


def press_in(page, place, text):
    """A button in a part of the page; not counted."""
    page.wait_for(f"!!{place}", 20)
    inside = desk.BUTTON.format(text).replace("document", place)
    page.wait_for(f"!!{inside}", 20)
    page.evaluate(f"{inside}.click()")


def look_through_recordings(page, address, home):
    """Each is checked, drawn, reported and deleted where it stands."""
    (home / "run-1" / "report.html").unlink()
    desk.go(page, address + "recordings")
    row = "document.querySelector('[data-recording=\"{}\"]')"
    run, session = row.format("run-1"), row.format("session-1")

    press_in(page, run, "3-D")
    page.wait_for("document.querySelector('.q-dialog canvas')?.width > 100", 30)
    press_in(page, "document.querySelector('.q-dialog')", "close")
    page.wait_for("!document.querySelector('.q-dialog')", 20)
    page.evaluate(f"window.row = {run}; true")
    press_in(page, run, "write the report")
    page.wait_for(f"!!{run}?.querySelector('a')?.offsetParent", 60)
    assert page.evaluate("row.isConnected")
    press_in(page, session, "check")
    page.wait_for(f"{session}?.querySelector('.findings')?.innerText.length > 5", 120)
    press_in(page, session, "delete")
    press_in(page, "document.querySelector('.q-dialog')", "keep it")
    page.wait_for("!document.querySelector('.q-dialog')", 20)
    assert (home / "session-1").is_dir()
    press_in(page, session, "delete")
    press_in(page, "document.querySelector('.q-dialog')", "delete it")
    page.wait_for(f"!{session} && !!{run}", 20)
    assert not (home / "session-1").exists()


def take_the_board_that_is_seen(page, address, home):
    """The world of before is taken back; then another board is waved than was chosen."""
    file = home / "calibration.toml"
    assert "world" in read_calibration(file).provenance
    desk.go(page, address + "calibration")
    page.wait_for(JUDGEMENT, 20)
    desk.press(page, "take back the world")
    page.wait_for(f"!{JUDGEMENT}", 20)
    before, calibration = file.read_bytes(), read_calibration(file)
    assert "world" not in calibration.provenance
    desk.press(page, "wave the board")
    page.wait_for(f"/this is another board/.test({ADVICE})", 60)
    desk.press(page, "take the board that is seen")
    chosen = "document.querySelector('.board-tile.chosen').dataset.board"
    page.wait_for(f"{chosen} == {waved.PLAIN!r}", 20)
    page.wait_for("/cam0: [1-9] picture/.test(document.body.innerText)", 60)
    desk.press(page, "stop")
    page.wait_for(f"/stopped: .* kept/.test({desk.FOOT})", 60)
    assert file.read_bytes() == before


def check_rig(home, mm, deg):
    """The cameras are where they are from the first one."""
    true, found = cameras(), read_calibration(home / "calibration.toml").cameras
    for one, there in zip(found, true, strict=True):
        assert one.intrinsics.focal_px == pytest.approx(there.intrinsics.focal_px, rel=0.01)
        ways = [
            first.world_from_camera.inverse() @ other.world_from_camera
            for first, other in ((found[0], one), (true[0], there))
        ]
        assert np.linalg.norm(ways[0].translation - ways[1].translation) < mm
        assert np.degrees(np.linalg.norm((ways[0] @ ways[1].inverse()).rotvec)) < deg


def check_body(home):
    found = read_body(home / "body-1.toml")
    for pair, length in own_object().body.distances().items():
        known = [name.replace("magenta", MAGENTA) for name in pair]
        off = np.subtract(*found.centers_of(known))
        assert np.linalg.norm(off) == pytest.approx(length, abs=0.3)


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
    scene, found = own_object(), read_body(home / "body-1.toml")
    up = RigidTransform(np.diag([1.0, -1, -1]), np.zeros(3))
    world = RigidTransform(np.eye(3), WORKSPACE_MM) @ CHARUCO.poses()[0] @ up
    resting = scene.trajectory.at(np.zeros(1))
    for name in scene.body.names:
        true = resting.apply(scene.body.centers[scene.body.index(name)][None])
        at = poses.apply(found.centers[found.index(name.replace("magenta", MAGENTA))][None])
        assert np.linalg.norm(at - world.inverse().apply(true), axis=-1).max() < 1.5

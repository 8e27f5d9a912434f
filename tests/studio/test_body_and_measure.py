"""In a browser: no click spoils a measurement, and what is old or doubtful looks so."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from measure.results import read_run
from measure.session import open_session, read_body, read_trajectory
from measure.simulation.catalogue import shaft, stems, webcam_scene
from measure_studio.page.layout import WIDTH_PX
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.simulated.catalogue import body
from tests.simulated.sessions import rendered
from tests.studio import waved
from tests.studio.desk import FOOT, click_at, fill, go, press, strike, studio
from tests.studio.test_from_nothing import CHARUCO, JUDGEMENT, at_rest, cameras, serve

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(600)]
PERIOD_S, OWN_PERIOD_S = 0.25, 0.3
MAGENTA = "pink"  # As the program calls it
SAYS = "document.body.innerText.includes({!r})"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length >= {}"
STATE = "document.querySelector('.pose')?.dataset.state"
AZIMUTHS_DEG = (60.0, 90.0, 120.0)  # Of the cameras before which a board is waved
POSES = "document.querySelector('[data-pose]')?.innerText"


def served(still, count, period_s=PERIOD_S):
    return {
        f"cam{k}": ServedCamera(
            [file.read_bytes() for file in sorted((still / f"cam{k}").glob("*.jpg"))],
            period_s,
            stamps=True,
        )
        for k in range(count)
    }


def desk_with(still, folder):
    folder.mkdir()
    for name in ("calibration.toml", "body.toml"):
        shutil.copy(still / name, folder)
    return folder


def own_object():
    """A recording of four balls of other colours than the paper's, before three cameras."""
    places = {
        "white": (34.0, 6.0, -4.0),
        "blue": (-8.0, 33.0, 6.0),
        "orange": (-31.0, -9.0, -6.0),
        "magenta": (6.0, -30.0, 14.0),
    }
    own = body("my object", places, 15.0)
    attached = (*stems(own), shaft(color=(0.02,) * 3))
    scene = replace(webcam_scene(), name="own", body=own, cameras=cameras(AZIMUTHS_DEG))
    return rendered(replace(scene, attached=attached), OWN_PERIOD_S * np.arange(10)), own


def test_an_object_of_ones_own_is_measured(tmp_path, rng):
    """From an empty folder: nobody chooses a colour; a click on the ground teaches nothing."""
    recording, true = own_object()
    desk, own = tmp_path / "desk", served(recording, 3, OWN_PERIOD_S)
    moving = {name: camera.pictures for name, camera in own.items()}
    for name, some in CHARUCO.pictures(rng, waved.rig(AZIMUTHS_DEG)).items():
        own[name].pictures = some
    with (
        serving(own) as found,
        Chromium(1440, 900) as page,
        studio(desk, *(f"{name}={at}" for name, at in found.items())) as address,
    ):
        go(page, address + "calibration")
        press(page, "wave the board")
        page.wait_for(f"/The cameras are calibrated/.test({JUDGEMENT})", 300)
        serve(own, {name: at_rest(some[0], rng) for name, some in moving.items()})  # to be clicked
        go(page, address + "body")
        page.wait_for(SHOWN.format(3), 60)
        page.wait_for("document.querySelectorAll('[data-ball]').length == 4", 120)
        top = "document.querySelector('img.live').getBoundingClientRect().top + scrollY"
        before = page.evaluate(top)
        click_at(page, "img.live", 20, 20)
        page.wait_for(SAYS.format("no ball-like patch"), 20)
        assert not (desk / "colours.toml").exists()
        click_at(page, "img.live", *seen_px(recording, true, "blue"))
        page.wait_for("!!document.querySelector('[data-ball=blue]')", 20)
        page.wait_until((desk / "colours.toml").exists, "blue is learnt", 20)
        assert page.evaluate(top) == before
        serve(own, moving)
        fill(page, "Radius of the balls, mm", "15")
        fill(page, "Seconds", "6")
        press(page, "record and measure")
        page.wait_for(f"/body-1.*4 balls/.test({FOOT})", 240)
        page.wait_for("document.querySelectorAll('.chip.sure').length == 4", 20)
        assert page.evaluate(top) >= before
        measured = read_body(desk / "body-1.toml")
        for pair, length in true.distances().items():
            known = [name.replace("magenta", MAGENTA) for name in pair]
            off = np.subtract(*measured.centers_of(known))
            assert np.linalg.norm(off) == pytest.approx(length, abs=0.3)
        go(page, address + "measure")
        press(page, "measure$")
        page.wait_for(f"{STATE} == 'OK'", 150)
        press(page, "stop")
        page.wait_for("!!document.querySelector('a.primary[href$=\"run-1/report.html\"]')", 90)
        assert page.errors == []
    assert sorted(file.name for file in desk.glob("session-*")) == ["session-1", "session-2"]
    run = read_run(desk / "run-1")
    assert run.unflagged[run.has_pose].sum() >= 2


def seen_px(recording, true, ball):
    """Where a ball is in the first camera's first picture, in px of the smaller one shown."""
    with open_session(recording) as session:
        pose = read_trajectory(recording / "truth.csv").at(session.streams["cam0"].times_s[:1])[0]
        center = pose.apply(true.centers[true.index(ball)][None])
        camera = session.cameras[0]
        scale = min(1.0, WIDTH_PX / camera.intrinsics.size_wh[0])
        return scale * (np.ravel(camera.project(center)) + 0.5) - 0.5


def test_state_is_large_and_nothing_looks_live_after_stop(still, tmp_path):
    desk = desk_with(still, tmp_path / "desk")
    with (
        serving(served(still, 4)) as found,
        Chromium(390, 840) as page,
        studio(desk, *(f"{name}={at}" for name, at in found.items())) as address,
    ):
        go(page, address + "measure")
        page.wait_for(SHOWN.format(1), 30)
        strike(page, "m", "m")
        page.wait_for(SAYS.format("nothing is being measured"), 20)
        press(page, "measure$")
        page.wait_for(f"{STATE} == 'OK' || {STATE} == 'DOUBTFUL'", 150)
        assert page.evaluate("!document.querySelector('.poses.old')")
        page.idle(2.0)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert not page.evaluate("!!document.querySelector('a[href$=\"report.html\"]')")
        press(page, "stop")
        page.wait_for(f"/poses good/.test({POSES})", 90)
        page.wait_for("!!document.querySelector('.poses.old .age')", 20)
        page.wait_for("!!document.querySelector('a.primary[href$=\"run-1/report.html\"]')", 20)
        assert not page.evaluate(SAYS.format("Compare with the truth"))
        assert page.errors == []

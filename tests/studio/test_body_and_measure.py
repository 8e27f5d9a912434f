"""In a browser: no click spoils a measurement, and what is old or doubtful looks so."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from measure.session import open_session, read_trajectory
from measure_studio.page.layout import WIDTH_PX
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.studio.desk import FOOT, choose, click_at, go, press, strike, studio

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(400)]
PERIOD_S = 0.25
SAYS = "document.body.innerText.includes({!r})"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length >= {}"
STATE = "document.querySelector('.poses .state')?.innerText"


def served(still, count):
    return {
        f"cam{k}": ServedCamera(
            [file.read_bytes() for file in sorted((still / f"cam{k}").glob("*.jpg"))],
            PERIOD_S,
            stamps=True,
        )
        for k in range(count)
    }


def desk_with(still, folder):
    folder.mkdir()
    for name in ("calibration.toml", "body.toml"):
        shutil.copy(still / name, folder)
    return folder


def yellow_px(still):
    """Where the yellow ball is in cam0, in px of the smaller picture that the page shows."""
    width = cv2.imread(str(min((still / "cam0").glob("*.jpg")))).shape[1]
    scale = WIDTH_PX / width
    with open_session(still) as session:
        times_s = session.streams["cam0"].times_s[:1]
        pose = read_trajectory(still / "truth.csv").at(times_s)[0]
        body = session.body
        center = pose.apply(body.centers[body.index("yellow")][None])
        return scale * (np.ravel(session.cameras[0].project(center)) + 0.5) - 0.5


def test_a_click_on_the_ground_teaches_nothing(still, tmp_path):
    """And what a ball teaches is shown, named and taken away again."""
    desk = desk_with(still, tmp_path / "desk")
    with (
        serving(served(still, 1)) as found,
        Chromium(1440, 900) as page,
        studio(desk, f"cam0={found['cam0']}") as address,
    ):
        go(page, address + "body")
        page.wait_for(SHOWN.format(1), 30)
        page.wait_for(SAYS.format("cam0: green, red, yellow"), 60)
        assert not page.evaluate(SAYS.format("no ball found"))
        choose(page, "Ball to click", "yellow")
        click_at(page, "img.live", 20, 20)
        page.wait_for(SAYS.format("no ball-like patch"), 20)
        assert not (desk / "colours.toml").exists()
        click_at(page, "img.live", *yellow_px(still))
        page.wait_for("!!document.querySelector('[data-learnt=yellow]')", 20)
        assert (desk / "colours.toml").exists()
        go(page, address + "measure")
        page.wait_for(SAYS.format("body.toml · "), 20)
        assert not page.evaluate(SAYS.format("colours.toml"))
        go(page, address + "body")
        press_forget = "document.querySelector('[data-learnt=yellow] button').click()"
        page.wait_for("!!document.querySelector('[data-learnt=yellow] button')", 20)
        page.evaluate(press_forget)
        page.wait_for("!document.querySelector('[data-learnt=yellow]')", 20)
        assert not (desk / "colours.toml").exists()


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
        page.wait_for(f"/run-1: .* believed/.test({FOOT})", 90)
        page.wait_for("!!document.querySelector('.poses.old .age')", 20)
        page.wait_for("!!document.querySelector('a.primary[href$=\"run-1/report.html\"]')", 20)
        assert not page.evaluate(SAYS.format("Compare with the truth"))
        assert page.errors == []

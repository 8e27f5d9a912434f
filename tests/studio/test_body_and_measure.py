"""In a browser: no click spoils a measurement, and what is old or doubtful looks so."""

from __future__ import annotations

import shutil

import pytest

from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.studio.desk import go, press, strike, studio

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(400)]
PERIOD_S = 0.25
SAYS = "document.body.innerText.includes({!r})"
SHOWN = "document.querySelectorAll('img.live[src^=blob]').length >= {}"
STATE = "document.querySelector('.pose')?.dataset.state"
POSES = "document.querySelector('[data-pose]')?.innerText"


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

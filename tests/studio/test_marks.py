"""In a browser: cameras are located by markers that are clicked, and what is clicked wrongly."""

from __future__ import annotations

import numpy as np
import pytest

from measure.api import shipped_targets
from measure.calibration.targets import read_markers
from measure.session import Calibration, read_calibration, write_calibration
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.studio import waved
from tests.studio.desk import FOOT, choose, click_at, go, press, studio
from tests.studio.test_from_nothing import at_rest, cameras, jpeg

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(600)]
FIELD = read_markers(shipped_targets()["raven_markers_16"])
NOTE = "document.querySelector('.q-notifications')?.innerText.includes({!r})"


def test_marks_locate_the_cameras_and_wrong_clicks_mark_nothing(tmp_path, rng):
    true = cameras((60, 120))
    pictures = {c.name: at_rest(jpeg(waved.dots(c, FIELD.points)), rng) for c in true}
    served = {name: ServedCamera(some, 0.3, stamps=True) for name, some in pictures.items()}
    write_calibration(tmp_path / "calibration.toml", Calibration(true))
    with serving(served) as addresses:
        words = [f"{name}={address}" for name, address in addresses.items()]
        with studio(tmp_path, *words) as address, Chromium(1280, 800) as page:
            go(page, address + "marks")
            page.wait_for("document.body.innerText.includes('comes here')", 20)
            open_pictures(page)
            click_wrongly(page, true)
            mark_the_dots(page, true)
            press(page, "write marks")
            page.wait_for("document.body.innerText.includes('marks-1/marks.csv is written')", 20)
            press(page, "locate the cameras")
            page.wait_for(f"/marks-1 gave calibration.toml/.test({FOOT})", 60)
            assert page.errors == []
    check_places(tmp_path, true)


def open_pictures(page):
    page.wait_for(
        "!!document.querySelector('.q-footer')?.innerText.includes('cameras deliver')", 30
    )
    choose(page, "Markers of", "raven_markers_16")
    press(page, "open$")
    page.wait_for("!!document.querySelector('.marked img')", 20)


def click_wrongly(page, true):
    """Beside every dot, too early, and too few to find others by: each is said, nothing is done."""
    name = choose_marker(page, 0)
    click_at(page, ".marked img", 3.0, 200.0)
    page.wait_for(NOTE.format(f"nothing was marked for {name}"), 20)
    assert page.evaluate("document.querySelectorAll('circle.mark').length") == 0
    press(page, "find$")
    page.wait_for(NOTE.format("found no other marker"), 20)
    press(page, "locate the cameras")
    page.wait_for(NOTE.format("not yet: no marker is marked"), 20)
    assert not page.evaluate("!!document.querySelector('.q-notification.bg-positive')")
    click_twice(page, true[0])


def click_twice(page, camera):
    """The second of two quick clicks is the next marker's, which is not there."""
    at, marked = camera.project(FIELD.points), "document.querySelectorAll('circle.mark').length"
    last = np.flatnonzero(camera.intrinsics.contains(at, 25.0))[-1]
    name = choose_marker(page, last)
    for _ in range(2):
        click_at(page, ".marked img", *at[last])
    page.wait_for(NOTE.format(f"{name} is there: nothing was marked for {FIELD.names[0]}"), 20)
    assert page.evaluate(f"{marked} == 1")
    choose_marker(page, last)
    press(page, "remove$")
    page.wait_for(f"{marked} == 0", 10)


def choose_marker(page, k):
    """Choose a marker in the list; its name."""
    name, rows = FIELD.names[k], "[...document.querySelectorAll('[data-marks] tr')]"
    row = f"{rows}.find(r => r.innerText.startsWith('{name}'))"
    page.wait_for(f"!!{row}", 10)
    page.evaluate(f"{row}.click()")
    page.wait_for(f"document.querySelector('input[aria-label=Marker]').value == '{name}'", 10)
    return name


def mark_the_dots(page, true):
    """Some are clicked, a little beside; the others are proposed, at their places."""
    for camera in true:
        press(page, f"{camera.name}$")
        page.wait_for(f"document.querySelector('.marked img').src.includes('{camera.name}')", 20)
        at = camera.project(FIELD.points)
        inside = np.flatnonzero(camera.intrinsics.contains(at, 25.0))
        for count, k in enumerate(inside[:: len(inside) // 4][:4], 1):
            choose_marker(page, k)
            click_at(page, ".marked img", *(at[k] + [1.6, -1.2]))
            page.wait_for(f"document.querySelectorAll('circle.mark').length == {count}", 10)
        press(page, "find$")
        page.wait_for(f"document.querySelectorAll('circle.mark').length >= {len(inside) - 2}", 20)


def check_places(desk, true):
    for one, there in zip(read_calibration(desk / "calibration.toml").cameras, true, strict=True):
        assert np.linalg.norm(one.center - there.center) < 2.0

"""In a browser: the 3-D viewer is served by the page's own server, and asks nobody else."""

from __future__ import annotations

from urllib.error import HTTPError
from urllib.request import ProxyHandler, build_opener

import pytest

from measure import api
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench
from measure_studio.page.server import add_viewer
from tests.chromium import Chromium
from tests.studio.desk import served

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def shown(bench):
    """The viewer alone."""
    return served(lambda application: add_viewer(application, bench), "/viewer/")


def foreign(page):
    return [r for r in page.requests if not r.startswith(("http://127.0.0.1:", "blob:", "data:"))]


def test_the_viewer_asks_this_machine_alone(tmp_path):
    """It would ask others for its letters, for news, and to tell that it was used."""
    bench = Bench(tmp_path, api.Registry.discover(), True, studio_api.CaptureRequest())
    with studio_api.web_viewer() as (viewer, _), shown(bench) as address, Chromium() as page:
        page.open(address)
        page.wait_for("document.body?.innerText.includes('while something is measured')", 20)
        bench.viewer = viewer
        page.open(f"{address}?{viewer.partition('?')[2]}")
        page.wait_for("document.querySelector('canvas')?.width > 300", 120)
        page.wait_until(lambda: any("ReadMessages" in r for r in page.requests), "data", 60)
        page.wait_until(lambda: "tel.rerun.io" in str(page.errors), "it is refused", 60)
        assert foreign(page) == []
        page.open(viewer)
        page.wait_until(lambda: bool(foreign(page)), "without the door it asks others", 60)


def test_a_laboratorys_proxy_is_not_asked_for_it(tmp_path, monkeypatch):
    bench = Bench(tmp_path, api.Registry.discover(), True, studio_api.CaptureRequest())
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    browser = build_opener(ProxyHandler({}))
    with studio_api.web_viewer() as (bench.viewer, _), shown(bench) as address:
        assert b"<html" in browser.open(address, timeout=20).read()
        with pytest.raises(HTTPError, match="404"):
            browser.open(f"{address}nothing.js", timeout=20)
    with shown(bench) as address, pytest.raises(HTTPError, match="404"):
        browser.open(address, timeout=20)

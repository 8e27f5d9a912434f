"""A real browser opens the report and the web viewer, with a screen's width and a telephone's."""

from __future__ import annotations

import contextlib
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from measurements import BODY, CAMERAS, measurement

from measure.results import Provenance, RunWriter, read_run
from measure.viewing.recording import RunRecording, open_recording
from measure_lab.run_report import run_report
from tests.chromium import Chromium

pytestmark = [pytest.mark.browser, pytest.mark.slow]
PROVENANCE = Provenance("/data/s", "a", "calibration.toml", "b", "c", {"name": "precise"}, {})
COUNT = 40
DRAWN = "[...document.querySelectorAll('.figure')].every(f => f.querySelector('.main-svg'))"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run's folder with its recording and its report."""
    folder = tmp_path_factory.mktemp("browser") / "run"
    with RunWriter(folder, PROVENANCE, [BODY], CAMERAS) as writer:
        for index in range(COUNT):
            writer.append(measurement(index, lost=index in (5, 6)))
        writer.finish()
    with RunRecording(
        open_recording("test", CAMERAS, folder / "run.rrd"), [BODY], CAMERAS, 0
    ) as log:
        for index in range(COUNT):
            log.add([measurement(index)])
    page = run_report([read_run(folder)], [np.full((COUNT, 6), 0.01)])
    (folder / "report.html").write_text(page, "utf-8")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    """One browser for all pages; each test starts with clean notes."""
    with Chromium() as page:
        yield page


@pytest.fixture
def page(browser: Chromium) -> Chromium:
    browser.requests.clear()
    browser.errors.clear()
    return browser


@pytest.mark.parametrize(
    ("width", "dark"), [(1600, False), (390, True)], ids=["1600-light", "390-dark"]
)
def test_the_report_draws_every_figure_and_fetches_nothing(
    run: Path, page: Chromium, width: int, dark: bool
):
    page.resize(width, 1000, dark)
    page.open((run / "report.html").as_uri())
    page.wait_for(f"document.readyState == 'complete' && {DRAWN}", 60)
    page.idle(0.5)
    assert page.errors == []
    assert [a for a in page.requests if not a.startswith(("file:", "data:", "blob:"))] == []
    figures = page.evaluate("document.querySelectorAll('.figure').length")
    assert figures == len(re.findall('class="figure"', (run / "report.html").read_text()))
    # Lines, bars, cells or points: a figure of axes alone has drawn nothing.
    marks = "path.js-line, .point, .heatmaplayer image, .gl-container canvas"
    empty = f"[...document.querySelectorAll('.figure')].filter(f => !f.querySelector('{marks}'))"
    assert page.evaluate(f"{empty}.map(f => f.id)") == []
    over = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert page.evaluate(over) <= 0, "the page is wider than the screen"


def test_a_figure_that_cannot_be_drawn_is_noticed(run: Path, page: Chromium, tmp_path: Path):
    """The checks above fail where they should; the page's own policy would stop such a page."""
    page_text = (run / "report.html").read_text("utf-8").replace("Plotly.newPlot(", "Plotly.none(")
    page_text, policies = re.subn(
        r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page_text
    )
    assert policies == 1
    remote = '<img src="http://127.0.0.1:9/x.png">'
    (tmp_path / "bad.html").write_text(page_text.replace("<main>", f"<main>{remote}"), "utf-8")
    page.open((tmp_path / "bad.html").as_uri())
    missing = "Plotly.none is not a function"
    page.wait_until(lambda: any(missing in error for error in page.errors), missing, 60)
    page.wait_for("document.readyState == 'complete'", 60)
    page.idle(0.5)
    assert not page.evaluate(DRAWN)
    assert "http://127.0.0.1:9/x.png" in page.requests


@contextlib.contextmanager
def _served(run: Path) -> Iterator[str]:
    """The address that `measure view --web` prints, while it runs."""
    command = [sys.executable, "-m", "measure", "view", "--web", str(run)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        try:
            yield process.stdout.readline().decode().strip()
        finally:
            process.terminate()
            process.wait(20)


def test_the_web_viewer_shows_a_run_from_loopback(run: Path, page: Chromium):
    with _served(run) as address:
        page.resize(500, 400)  # Its pixels are drawn without a graphics card
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)\?url=rerun%2Bhttp://(.+)/proxy", address)
        assert found, address
        web, data = f"http://127.0.0.1:{found[1]}/", f"http://{found[2]}/"
        assert data.startswith("http://127.0.0.1:")
        page.open(address)
        page.wait_until(
            lambda: any(a.startswith(data) for a in page.requests), "the data are fetched", 120
        )
        page.wait_for("document.querySelector('canvas')?.width > 300", 60)
        page.idle(1.0)
        title = page.evaluate("document.title")
        assert "Rerun" in title
        # The viewer looks for news of itself on the internet; what fails there is none of ours.
        ours = [e for e in page.errors if web in e or data in e or "panic" in e.lower()]
        assert [e for e in ours if "https://" not in e and "Failed to fetch" not in e] == []
        assert len(np.unique(np.frombuffer(page.screenshot(), np.uint8))) > 100
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", int(found[1]))), "the viewer outlives `measure view`"

"""Files of the folder as the studio serves them: pages of strangers among them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import numpy as np
import plotly.graph_objects as go
import pytest
from fastapi import FastAPI
from starlette.responses import HTMLResponse

from measure.viewing.report.page import Page
from measure_studio.page.server import add_files
from tests.chromium import Chromium
from tests.studio.desk import served

ATTACK = """<html><body><p id="what">begun</p><script>
const told = document.getElementById("what");
const tries = ["/secret", "http://127.0.0.1:9/"].map((there) => fetch(there).then((r) => r.text()));
let cookie; try { cookie = document.cookie; } catch { cookie = "none"; }
Promise.allSettled(tries).then((ends) => {
  told.textContent = [origin, cookie, ...ends.map((one) => one.status)].join(" ");
});
</script></body></html>"""


def files_of(folder: Path) -> Callable[[FastAPI], None]:
    """The files alone, and a secret page."""

    def fill(application: FastAPI) -> None:
        add_files(application, folder)
        application.get("/secret")(lambda: HTMLResponse(f"{ATTACK}<b>secret</b>"))

    return fill


@pytest.mark.parametrize(
    "name", ["a%00.csv", "%00", "a" * 300 + ".csv", "loop.csv", "..%2fout.csv", "no.csv", "x.toml"]
)
def test_what_is_no_file_of_the_folder_is_not_found(tmp_path, name, capfd):
    folder = tmp_path / "desk"
    folder.mkdir()
    (tmp_path / "out.csv").write_text("secret")
    (folder / "x.toml").write_text("")
    (folder / "loop.csv").symlink_to(folder / "loop.csv")
    with served(files_of(folder)) as address, pytest.raises(HTTPError, match="404"):
        urlopen(f"{address}/file/{name}", timeout=20)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize(("name", "boxed"), [("a.html", True), ("A.SVG", True), ("a.csv", False)])
def test_pages_of_the_folder_go_out_in_a_box(tmp_path, name, boxed):
    (tmp_path / name).write_text("<svg/>")
    with (
        served(files_of(tmp_path)) as address,
        urlopen(f"{address}/file/{name}", timeout=20) as answer,
    ):
        policy = answer.headers["Content-Security-Policy"]
        assert ("sandbox" in policy) == boxed
        assert "allow-same-origin" not in policy
        assert "frame-ancestors 'self'" in policy
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.browser
@pytest.mark.slow
def test_reports_draw_and_a_strangers_page_reaches_nothing(tmp_path):
    page = Page("A report", "good", "good")
    at = np.arange(5.0)
    flat = go.Figure(go.Scatter(x=at, y=at), go.Layout(height=300))
    deep = go.Figure(go.Scatter3d(x=at, y=at, z=at, mode="markers"), go.Layout(height=300))
    page.figures("Two", "", flat, deep)
    (tmp_path / "report.html").write_text(page.render("end"), "utf-8")
    (tmp_path / "evil.html").write_text(ATTACK, "utf-8")
    inlined = page.render("end").replace("</main>", "<script>document.title = 'mine'</script>")
    (tmp_path / "spoilt.html").write_text(inlined, "utf-8")
    told = "(document.getElementById('what')?.textContent ?? 'begun')"
    with served(files_of(tmp_path)) as address, Chromium() as browser:
        browser.open(f"{address}/file/report.html")
        drawn = "document.querySelectorAll('.main-svg, .gl-container canvas').length"
        browser.wait_for(f"document.readyState == 'complete' && {drawn} > 3", 60)
        assert browser.errors == []
        browser.open(f"{address}/file/evil.html")
        browser.wait_for(f"{told} != 'begun'", 60)
        assert browser.evaluate(told) == "null none rejected rejected"
        browser.open(f"{address}/file/spoilt.html")
        browser.wait_for("document.readyState == 'complete'", 60)
        assert browser.evaluate("document.title") == "A report"
        browser.open(f"{address}/secret")  # the same, as a page of this server's own
        browser.wait_for(f"{told} != 'begun'", 60)
        assert browser.evaluate(told) == f"{address}  fulfilled rejected"

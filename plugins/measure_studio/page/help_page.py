"""What is asked most at each step, on one page: what words mean, and what to do about a finding."""

from __future__ import annotations

from importlib import resources

from nicegui import ui

from measure_studio.page.bench import Bench
from measure_studio.page.layout import HELP, page


def add(bench: Bench) -> None:
    """Add the page; its text stands in `static/help.html`, with an anchor for each step."""
    text = resources.files("measure_studio").joinpath("static", "help.html").read_text("utf-8")

    @ui.page(HELP)
    def help_page() -> None:
        with page(bench, HELP):
            ui.html(text, sanitize=False).classes("asked")

"""A desk with cameras and the page that serves it, for the tests."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from measure_studio.page.door import Door
from tests.chromium import Chromium

BUTTON = "[...document.querySelectorAll('button')].find(b => b.innerText.trim().match(/{}/i))"
FOOT = "document.querySelector('.q-footer').innerText"

_SLOW_S = 1.5  # How long a page may take to open a menu on a busy machine


@contextmanager
def studio(folder: Path, *words: str) -> Iterator[str]:
    """`measure studio` in a process of its own; yields the address that it prints."""
    command = [sys.executable, "-m", "measure", "studio", str(folder), *words]
    with subprocess.Popen(
        [*command, "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
            process.wait(30)
    assert process.returncode == 0


@contextmanager
def served(fill: Callable[[FastAPI], object], path: str = "") -> Iterator[str]:
    """What `fill` adds to an application, behind the page's door; yields the path's address."""
    fill(application := FastAPI())
    config = uvicorn.Config(Door(application), port=0, log_level="error")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}{path}"
    finally:
        server.should_exit = True
        thread.join()


def go(page: Chromium, address: str) -> None:
    """Open an address, and wait until what is done there is heard."""
    page.open(address)
    page.wait_for("!!window.did_handshake", 60)


def count(page: Chromium, clicks: int = 1, typed: int = 0) -> None:
    """Count what a person would have done on this page."""
    title = page.evaluate("document.title").partition(" ")[0]
    page.steps[title, "clicks"] += clicks
    page.steps[title, "typed"] += typed


def go_on(page: Chromium, name: str) -> None:
    """Press Next, which leads to the page of this name."""
    link = "document.querySelector('[data-next]')"
    page.wait_for(f"{link}?.innerText == 'Next: {name}'", 20)
    count(page)
    page.evaluate(f"{link}.click()")
    here = f"document.querySelector('.way a.here')?.dataset.step == '{name}'"
    page.wait_for(f"{here} && !!window.did_handshake", 60)


ONE_PRIMARY = """[...document.querySelectorAll('.act')].filter(one => one.offsetParent
    && getComputedStyle(one).backgroundColor != 'rgba(0, 0, 0, 0)').length == 1"""
"""JavaScript: one button stands out on this page."""


def is_done(name: str) -> str:
    """JavaScript: whether the step of this name bears a tick."""
    return f"!!document.querySelector('.way a.done[data-step={name}]')"


def press(page: Chromium, text: str) -> None:
    """Click the button with this text."""
    page.wait_for(f"!!{BUTTON.format(text)}", 20)
    page.evaluate(f"((button) => {{ button.focus(); button.click() }})({BUTTON.format(text)})")
    count(page)


def choose(page: Chromium, label: str, text: str) -> None:
    """Choose in the select with this label what holds this text."""
    field = f"""[...document.querySelectorAll('.q-select')]
        .find(s => s.innerText.includes({label!r}))"""
    page.wait_for(f"!!{field}", 20)
    option = f"""[...document.querySelectorAll('.q-menu .q-item')]
        .find(i => i.innerText.split(' · ')[0] == {text!r})"""
    closed = "!document.querySelector('.q-menu')"
    place = f"""(() => {{
        const control = {field}.querySelector('.q-field__control');
        control.scrollIntoView({{block: 'center'}});
        const box = control.getBoundingClientRect();
        return [box.left + box.width / 2, box.top + box.height / 2];
    }})()"""

    patience_s = _SLOW_S / 2

    def is_there() -> bool:
        """A page that has much to do may miss a click; one that is slow is not clicked shut."""
        nonlocal patience_s
        if page.evaluate(f"!!{option}"):
            return True
        if page.evaluate(closed):
            mouse(page, *page.evaluate(place))
        patience_s *= 2
        until_s = time.monotonic() + patience_s
        while not (there := page.evaluate(f"!!{option}")) and time.monotonic() < until_s:
            page.idle(0.2)
        return bool(there)

    page.wait_until(is_there, f"{text} can be chosen", 60)
    page.evaluate(f"{option}.click()")
    count(page, 2)


def fill(page: Chromium, label: str, text: str) -> None:
    """Type into the field with this label, in place of what it holds; not counted."""
    field = f"""document.querySelector('input[aria-label="{label}"]')"""
    page.wait_for(f"!!{field}", 20)
    page.evaluate(f"{field}.select()")
    page.send("Input.insertText", text=text)


def strike(page: Chromium, key: str, text: str) -> None:
    """Strike a key."""
    for kind in ("keyDown", "keyUp"):
        page.send("Input.dispatchKeyEvent", type=kind, key=key, text=text * (kind == "keyDown"))
    count(page, 0, 1)


def click_at(page: Chromium, image: str, u_px: float, v_px: float) -> None:
    """Point at a place in an image, in px of the picture that it shows, and click; not counted."""
    place = f"""(() => {{
        const image = document.querySelector('{image}');
        if (!(image?.naturalWidth > 0)) return null;
        image.scrollIntoView({{block: 'center'}});
        const box = image.getBoundingClientRect();
        const scale = Math.min(box.width / image.naturalWidth, box.height / image.naturalHeight);
        return [box.left + box.width / 2, box.top + box.height / 2,
                scale, image.naturalWidth, image.naturalHeight];
    }})()"""
    # Pictures follow each other: what is read of one is read at once.
    x, y, scale, width, height = page.wait_for(place, 20)
    # Pixel centres are at integers, and the picture begins half a pixel before the first.
    x, y = x + scale * (u_px + 0.5 - width / 2), y + scale * (v_px + 0.5 - height / 2)
    mouse(page, x, y)


def mouse(page: Chromium, x: float, y: float) -> None:
    """Point at a place in the window, in px, and click."""
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

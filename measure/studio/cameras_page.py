"""The cameras: live pictures, and whether each can be measured with."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from nicegui import ui

from measure import api
from measure.studio.bench import Bench
from measure.studio.layout import choice, chosen, page, picture, put, tried, typed

WIDTH_PX = 480
_BLURRED, _CLIPPED, _DARK = 0.12, 0.01, 0.2
"""Below, above and below which a picture is called blurred, overexposed and dark."""
_NAMED = re.compile(r"[\w.-]+=")
_FACTS = ("state", "rate", "drops", "times", "sharpness", "exposure", "balls")


def add(bench: Bench) -> None:
    """Add the page."""

    @ui.page("/", title="Cameras")
    def cameras() -> None:
        with page(bench, "/"):
            _head(bench, cards.refresh)
            cards(bench)

    @ui.refreshable
    def cards(bench: Bench) -> None:
        if not bench.cameras:
            ui.label("No camera yet. Add the first one above.").classes("hint")
        with ui.element("div").classes("cards"):
            for one in bench.cameras:
                ui.timer(0.5, _card(bench, one, cards.refresh))


def _head(bench: Bench, refresh: Callable[[], object]) -> None:
    """A camera to add, and the body to look for."""

    async def take() -> None:
        word = address.value.strip()
        named = word if _NAMED.match(word) else f"cam{len(bench.cameras)}={word}"
        known = [f"{one.name}={one.address}" for one in bench.cameras]
        await tried(lambda: bench.set_cameras(api.parse_cameras([*known, named])))
        if len(bench.cameras) > len(known):
            address.value = ""
            refresh()

    async def look() -> None:
        bench.body = next(iter(chosen(bench, body)), None)
        await tried(bench.look_for_balls)

    with ui.row().classes("line"):
        address = typed("Camera", "http://10.0.0.5:8080/?action=stream, or 0, or left=0")
        address.on("keydown.enter", take)
        ui.button("Add", icon="add", on_click=take)
        bodies = api.contents_of(bench.folder).bodies
        body = choice("Body to look for", bench, bodies, newest=False)
        if bench.body is not None:
            body.value = str(bench.body.relative_to(bench.folder))
        body.on_value_change(look)

    async def set_controls() -> None:
        given = controls.value or ""
        await tried(lambda: bench.set_controls(given, lock.value))

    with ui.row().classes("line"):
        controls = typed("Controls of this computer's cameras", "exposure=150, cam1.gain=0")
        lock = ui.checkbox("lock what is automatic", value=bench.given.lock)
        controls.on("keydown.enter", set_controls)
        ui.button("Set", on_click=set_controls)


def _card(
    bench: Bench, camera: api.CameraAddress, refresh: Callable[[], object]
) -> Callable[[], None]:
    """One camera; gives what shows its state of the moment."""
    name = camera.name

    async def remove() -> None:
        others = [one for one in bench.cameras if one.name != name]
        await tried(lambda: bench.set_cameras(others))
        refresh()

    with ui.card().props(f'data-camera="{name}"') as card:
        picture(name, WIDTH_PX)
        with ui.row().classes("line"):
            ui.label(name).classes("text-h6")
            ui.space()
            button = ui.button(icon="delete", on_click=remove)
            button.props(f'flat dense aria-label="remove {name}"')
        with ui.element("div").classes("facts"):
            labels = {what: (ui.label(what), ui.label())[1] for what in _FACTS}

    def show() -> None:
        put(card, "away", bool(bench.problem(name)))
        for what, (text, kind) in _told(bench, name).items():
            labels[what].text = text
            labels[what].classes(replace=kind)

    return show


def _told(bench: Bench, name: str) -> dict[str, tuple[str, str]]:
    """What each line says, and how it is meant."""
    problem, balls = bench.problem(name), bench.preview.balls(name)
    told = {"state": (problem or "delivers", "wrong" if problem else "good")}
    if name in bench.now:
        count = bench.now[name].count
        lost = "weak" if count.outages or count.refused else ""
        rate = "" if math.isnan(count.rate_hz) else f"{count.rate_hz:.1f} per s"
        told |= {
            "rate": (rate, ""),
            "times": ("its own clock" if count.own_clock else "of arrival", ""),
        }
        told["drops"] = f"{len(count.outages)} outages, {count.refused} torn", lost
        told["balls"] = ", ".join(balls) or ("none" if bench.body else ""), ""
    facts = bench.preview.facts(name)
    return told if facts is None else told | _judged(facts)


def _judged(facts: api.PictureFacts) -> dict[str, tuple[str, str]]:
    blurred, clipped = facts.sharpness < _BLURRED, facts.clipped_share > _CLIPPED
    size = f"{facts.size_wh[0]} x {facts.size_wh[1]} px"
    sharp = f"{facts.sharpness:.2f} per px, {size}" + (", blurred" if blurred else "")
    told = f"brightest {100 * facts.level:.0f} %, overexposed {100 * facts.clipped_share:.1f} %"
    word = ", too bright" if clipped else ", dark" if facts.level < _DARK else ""
    return {
        "sharpness": (sharp, "weak" if blurred else ""),
        "exposure": (told + word, "weak" if word else ""),
    }

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
            shown = [_Card(bench, one, cards.refresh) for one in bench.cameras]

        def show() -> None:
            for card in shown:
                card.show()

        ui.timer(0.5, show)


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


class _Card:
    """One camera."""

    def __init__(
        self, bench: Bench, camera: api.CameraAddress, refresh: Callable[[], object]
    ) -> None:
        self._bench, self._name = bench, camera.name

        async def remove() -> None:
            others = [one for one in bench.cameras if one.name != camera.name]
            await tried(lambda: bench.set_cameras(others))
            refresh()

        with ui.card().props(f'data-camera="{camera.name}"') as self._card:
            picture(camera.name, WIDTH_PX)
            with ui.row().classes("line"):
                ui.label(camera.name).classes("text-h6")
                ui.space()
                ui.button(icon="delete", on_click=remove).props(
                    f'flat dense aria-label="remove {camera.name}"'
                )
            with ui.element("div").classes("facts"):
                self._facts = {what: (ui.label(what), ui.label())[1] for what in _FACTS}

    def show(self) -> None:
        """Show the state of this moment."""
        now = self._bench.now.get(self._name)
        problem = "not read" if now is None else now.problem
        put(self._card, "away", bool(problem))
        self._say("state", problem or "delivers", "wrong" if problem else "good")
        if now is None:
            return
        count = now.count
        self._say("rate", "" if math.isnan(count.rate_hz) else f"{count.rate_hz:.1f} per s")
        self._say("drops", f"{len(count.outages)} outages, {count.refused} torn",
                  "weak" if count.outages or count.refused else "")  # fmt: skip
        self._say("times", "its own clock" if count.own_clock else "of arrival")
        if (facts := self._bench.preview.facts(self._name)) is not None:
            self._judge(facts)
        balls = self._bench.preview.balls(self._name)
        self._say("balls", ", ".join(balls) if balls else "none" if self._bench.body else "")

    def _judge(self, facts: api.PictureFacts) -> None:
        blurred = facts.sharpness < _BLURRED
        size = f"{facts.size_wh[0]} x {facts.size_wh[1]} px"
        sharp = f"{facts.sharpness:.2f} per px, {size}" + (", blurred" if blurred else "")
        self._say("sharpness", sharp, "weak" if blurred else "")
        clipped, dark = facts.clipped_share > _CLIPPED, facts.level < _DARK
        told = f"brightest {100 * facts.level:.0f} %, overexposed {100 * facts.clipped_share:.1f} %"
        word = ", too bright" if clipped else ", dark" if dark else ""
        self._say("exposure", told + word, "weak" if word else "")

    def _say(self, what: str, text: str, kind: str = "") -> None:
        self._facts[what].text = text
        self._facts[what].classes(replace=kind)

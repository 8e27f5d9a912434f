"""The cameras: live pictures, and whether each can be measured with."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from nicegui import ui

from measure import api
from measure.errors import ConfigError
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench
from measure_studio.page.layout import (
    WIDTH_PX,
    act,
    button,
    choice,
    chosen,
    details,
    empty,
    intro,
    page,
    picture,
    pictures,
    show_state,
    tell,
    tried,
    typed,
)
from measure_studio.page.words import plain

_SHARP, _BLURRED, _CLIPPED, _DARK = 0.2, 0.12, 0.01, 0.2
"""Sharp from the first on; below, above and below the others blurred, overexposed and dark."""
_NAMED = re.compile(r"[^/:?\\=]+=")
_FACTS = (
    "state", "rate", "drops", "times", "size", "sharpness", "exposure", "overexposed", "balls",
)  # fmt: skip


def add(bench: Bench) -> None:
    """Add the page."""

    @ui.page("/")
    def cameras() -> None:
        with page(bench, "/"):
            intro("Add two cameras or more, each looking at the place where you will measure.")
            _head(bench, cards.refresh)
            cards(bench)

    @ui.refreshable
    def cards(bench: Bench) -> None:
        if not bench.cameras:
            empty("The cameras' pictures come here: find those of this computer, or type one.")
        with pictures():
            for one in bench.cameras:
                ui.timer(0.5, _card(bench, one, cards.refresh))


def _added(bench: Bench, word: str) -> list[studio_api.CameraAddress]:
    """The cameras with those that were typed, all streaming; ConfigError if not."""
    if not word:
        raise ConfigError("type the address of a camera, or find those of this computer")
    free = next(f"cam{k}" for k in range(len(bench.names) + 1) if f"cam{k}" not in bench.names)
    named = word if _NAMED.match(word) else f"{free}={word}"
    known = [f"{one.name}={one.address}" for one in bench.cameras]
    cameras = studio_api.parse_cameras([*known, named])
    fresh = cameras[len(known) :]
    for one in fresh:
        if not (one.is_device or "://" in one.address):
            api.inside(bench.folder, one.address)
    answers = studio_api.cameras([one.below(bench.folder).address for one in fresh])
    for one, answer in zip(fresh, answers, strict=True):
        if answer.problem:
            problem = plain(answer.problem, bench.folder)
            raise ConfigError(f"{one.name} was not added: {problem}")
    return cameras


def _head(bench: Bench, refresh: Callable[[], object]) -> None:
    """A camera to add or to find; what is seldom needed is folded away."""

    async def take(word: str) -> bool:
        before = len(bench.cameras)
        await tried(lambda: bench.set_cameras(_added(bench, word)))
        refresh()
        return len(bench.cameras) > before

    async def take_typed() -> None:
        adding.props("loading")
        if await take((address.value or "").strip()):
            address.value = ""
        adding.props(remove="loading")

    with ui.row().classes("line"):
        adding = button("Add", "add", take_typed, primary=True)
        address = typed("Camera", "http://10.0.0.5:8080/?action=stream, or 0, or left=0")
        address.on("keydown.enter", take_typed)
        _finder(bench, take)
    _seldom(bench)


def _finder(bench: Bench, take: Callable[[str], object]) -> None:
    """The cameras of this computer, in a list that opens; each with a button."""

    async def find() -> None:
        found = await tried(studio_api.cameras)
        if found is None:
            return
        used = {one.device for one in bench.cameras}
        left = [one for one in found if not used & {one.address, one.path}]
        if not left:
            also = "no other camera" if found else "no camera"
            tell(f"{also} at this computer: those of the network are typed", "warning")
        listed.clear()
        with listed:
            for one in left:
                ui.button(
                    f"Add {one.name}", icon="videocam", on_click=lambda a=one.address: take(a)
                ).props("flat no-caps").classes("act")

    button("Find cameras of this computer", "search", find)
    listed = ui.row().classes("line").props("data-found")


def _seldom(bench: Bench) -> None:
    """The body to look for, and controls of this computer's cameras."""

    async def look() -> None:
        bench.body = next(iter(chosen(bench, body)), None)
        bodies = [api.read_body(bench.body)] if bench.body is not None else []
        await tried(lambda: bench.look_for(bodies))

    def set_controls() -> str:
        if not any(one.is_device for one in bench.cameras):
            raise ConfigError(
                "only cameras of this computer can be set here: those of the network are set "
                "where they are served"
            )
        bench.set_controls(controls.value or "", lock.value)
        return "the cameras are set"

    with details("More: a body to look for, exposure and focus"):
        with ui.row().classes("line"):
            body = choice("Body to look for", bench, "bodies", newest=False)
            looked_for = str(bench.body.relative_to(bench.folder)) if bench.body else None
            body.value = looked_for if looked_for in body.options else None
            body.on_value_change(look)
        with ui.row().classes("line"):
            controls = typed("Controls of this computer's cameras", "exposure=150, cam1.gain=0")
            lock = ui.checkbox("lock what is automatic", value=bench.given.lock)
            act("Set", "tune", set_controls)


def _card(
    bench: Bench, camera: studio_api.CameraAddress, refresh: Callable[[], object]
) -> Callable[[], None]:
    """One camera; gives what shows its state of the moment."""
    name = camera.name

    async def remove() -> None:
        asked.close()
        others = [one for one in bench.cameras if one.name != name]
        await tried(lambda: bench.set_cameras(others))
        refresh()

    with ui.dialog() as asked, ui.card():
        ui.label(f"Take {name} away? Its address has to be given again then.").classes("named-all")
        with ui.row():
            button("Take it away", "delete", remove, primary=True)
            button("Keep it", "undo", asked.close)
    with ui.card() as card:
        card.props["data-camera"] = name
        picture(name, WIDTH_PX)
        with ui.row().classes("line no-wrap"):
            ui.label(name).classes("text-h6 named")
            bin_button = ui.button(icon="delete", on_click=asked.open, color=None)
            bin_button.props("flat dense")
            bin_button.props["aria-label"] = f"remove {name}"
        with ui.element("div").classes("facts"):
            labels = {what: (ui.label(what), ui.label())[1] for what in _FACTS}

    def show() -> None:
        show_state(bench, name, card)
        for what, (text, kind) in _told(bench, name).items():
            labels[what].text = text
            labels[what].classes(replace=kind)

    return show


def _told(bench: Bench, name: str) -> dict[str, tuple[str, str]]:
    """What each line says, and how it is meant."""
    (state, why), balls = bench.state(name), bench.preview.balls(name)
    kind = {"live": "good", "away": "wrong", "held": ""}[state]
    cells = {"state": (why or "delivers", kind)}
    if name in bench.now:
        count = bench.now[name].count
        lost = "weak" if count.outages or count.refused else ""
        rate = "" if math.isnan(count.rate_hz) else f"{count.rate_hz:.1f} per s"
        cells |= {
            "rate": (rate, ""),
            "times": ("its own clock" if count.own_clock else "of arrival", ""),
        }
        often = len(count.outages)
        away = f"away {often} times" if often > 1 else "away once" if often else "never away"
        cells["drops"] = f"{away}, {count.refused} torn", lost
        looked = bench.looks and bench.preview.has_looked(name)
        none = "none" if looked else "choose a body under More"
        if bench.searched and not looked:
            none = "..." if state == "live" else ""
        cells["balls"] = ", ".join(balls) or none, ""
    facts = bench.preview.facts(name)
    return cells if facts is None else cells | _judged(facts)


def _judged(facts: studio_api.PictureFacts) -> dict[str, tuple[str, str]]:
    blurred, clipped = facts.sharpness < _BLURRED, facts.clipped_share > _CLIPPED
    size = f"{facts.size_wh[0]} x {facts.size_wh[1]} px"
    sharpness = "blurred" if blurred else "sharp" if facts.sharpness >= _SHARP else "soft"
    sharp = f"{sharpness}, {facts.sharpness:.2f} per px"
    dark = facts.level < _DARK
    return {
        "size": (size, ""),
        "sharpness": (sharp, "good" if sharpness == "sharp" else "weak"),
        "exposure": (f"brightest {100 * facts.level:.0f} %" + ", dark" * dark, "weak" * dark),
        "overexposed": (f"{100 * facts.clipped_share:.1f} %", "weak" if clipped else "good"),
    }

"""Marks: markers are clicked in one picture a camera, and cameras are located by them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from shutil import rmtree
from urllib.parse import quote

from nicegui import events, ui

from measure import api
from measure.errors import ConfigError, MeasureError
from measure_studio import api as studio_api
from measure_studio.page.bench import Bench
from measure_studio.page.layout import (
    Hint,
    act,
    button,
    choice,
    chosen,
    empty,
    intro,
    link,
    live_label,
    page,
    put,
    tried,
)

_NOW = "the cameras now"
_SOURCES = ("capture", "session")  # Files by which a folder holds pictures to mark
_COLUMNS = ("marker", "x y z mm", "u v px")


@dataclass
class _MarksPage:
    """What is being marked; it outlives the browser's page."""

    bench: Bench
    source: str = _NOW
    camera: str = ""
    name: str = ""
    place: str = ""
    kind: api.MarkKind = "dot"
    family: str = api.TAG_FAMILIES[0]
    marking: api.Marking | None = None
    report: Path | None = None
    shown: dict[str, str] = field(default_factory=dict)  # address of each camera's picture

    def open(self, calibrations: list[Path], markers: Path | None) -> None:
        """Begin with new pictures, or go on with those of a capture."""
        folder, source = self.bench.folder, self.bench.folder / self.source
        if (source / "capture.toml").is_file():
            marking = api.Marking(source, next(iter(calibrations), None))
        elif not calibrations:
            raise ConfigError("choose a calibration, for its lenses: step 2, Calibration, makes it")
        else:
            out = folder / studio_api.next_free(folder, "marks")
            try:
                if self.source == _NOW:
                    self.bench.preview.write([one.name for one in self.bench.cameras], out)
                    source = out
                marking = api.begin_marks(out, source, calibrations[0], markers)
            except BaseException:
                rmtree(out, ignore_errors=True)
                raise
        self.shown = {
            name: f"/file/{quote(str(api.inside(folder, file).relative_to(folder)))}"
            for name, file in marking.pictures.items()
        }
        self.marking, self.camera = marking, next(iter(self.shown))
        self.choose(next(iter(marking.points), ""))

    def choose(self, name: str) -> None:
        """Choose a marker by its name."""
        known = self.marking.points if self.marking else {}
        self.place = ", ".join(f"{x:g}" for x in known[name]) if name in known else ""
        self.name = name

    def click(self, marking: api.Marking, camera: str, at_px: tuple[float, float]) -> None:
        """Mark the chosen marker in a camera's picture, and go on to the next without a mark."""
        marking.set(camera, self.name, at_px, self.kind)
        if self.place.strip():
            marking.place(self.name, self.place)
        left = (name for name in marking.points if name not in marking.marks[camera])
        self.choose(next(left, self.name))

    def remove(self, marking: api.Marking) -> None:
        """Take the chosen mark out of the picture."""
        marking.marks[self.camera].pop(self.name, None)

    def find(self, marking: api.Marking, bodies: list[Path]) -> str:
        """Propose what is found in the picture."""
        balls = (api.read_body(bodies[0]), self.bench.registry) if bodies else None
        found = marking.propose(self.camera, self.family, self.kind, balls)
        if found:
            return f"{self.camera}: found {', '.join(found)}"
        first = "click four whose places are known first"
        return Hint(f"{self.camera}: found no other marker; {first}")

    def save(self, marking: api.Marking) -> str:
        """Write the marks."""
        left = marking.save()
        without = f"; without a place: {', '.join(left)}" if left else ""
        return f"{marking.folder.name}/marks.csv is written{without}"

    def locate(self, marking: api.Marking) -> str | None:
        """Locate the cameras by the marks, as soon as there are enough."""
        try:
            marking.save()
        except MeasureError as too_early:
            return Hint(f"not yet: {too_early}")
        self.bench.calibrate(marking.folder, lambda _, report: setattr(self, "report", report))
        return None

    def counted(self, marking: api.Marking) -> str:
        """How many marks of markers at known places each camera has."""
        known, marks = marking.points.keys(), marking.marks.items()
        return "Marked: " + ", ".join(f"{name} {len(mine.keys() & known)}" for name, mine in marks)

    def rows(self, marking: api.Marking) -> list[dict[str, str]]:
        """Every marker, where it is, and where it is seen."""
        points, mine = marking.points, marking.marks[self.camera]
        rows = []
        for name in sorted(points.keys() | mine.keys()):
            place = " ".join(f"{x:g}" for x in points[name]) if name in points else "?"
            cells = name, place, _where(mine[name]) if name in mine else ""
            rows.append(dict(zip(_COLUMNS, cells, strict=True)))
        return rows

    def drawn(self, name: str, mark: api.Mark) -> str:
        """A mark as SVG. Pixel centres are at integers; SVG counts from the picture's corner."""
        u, v, radius = mark.center_px[0] + 0.5, mark.center_px[1] + 0.5, mark.radius_px or 6.0
        kind = "chosen" if name == self.name else "refined" if mark.refined else "clicked"
        return (
            f'<circle class="mark {kind}" cx="{u:.3f}" cy="{v:.3f}" r="{radius:.2f}"/>'
            f'<text class="mark" x="{u + radius + 3:.1f}" y="{v - 3:.1f}">{escape(name)}</text>'
        )


def _where(mark: api.Mark) -> str:
    size = f", radius {mark.radius_px:.2f}" if mark.radius_px else ""
    how = "" if mark.refined else ", as clicked"
    return f"{mark.center_px[0]:.2f} {mark.center_px[1]:.2f}{size}{how}"


def add(bench: Bench) -> None:
    """Add the page."""
    marks = _MarksPage(bench)

    @ui.page("/marks")
    def page_of_marks() -> None:
        with page(bench, "/marks"):
            intro(
                "Where markers stand at known places: take a picture of each camera, click four "
                "markers in each, let the others be found, and locate the cameras by them."
            )
            _head(bench, marks, view.refresh)
            view()

    @ui.refreshable
    def view() -> None:
        if marks.marking is None:
            empty("The picture to click in comes here: choose the markers, and press Open.")
        else:
            _steps(bench, marks, marks.marking)
            _picture(marks, marks.marking)


def _head(bench: Bench, marks: _MarksPage, refresh: Callable[[], object]) -> None:
    """The pictures to mark, and the markers whose places are known."""
    there = studio_api.contents_of(bench.folder)
    sources = {f.parent.name for f in bench.folder.glob("*/*.toml") if f.stem in _SOURCES}
    own = [*there.bodies, *there.boards, *sorted(bench.folder.glob("*.csv"))]
    targets = {str(file.relative_to(bench.folder)): file for file in own}
    targets |= {name: f for name, f in api.shipped_targets().items() if "markers" in name}

    async def begin() -> None:
        await tried(lambda: marks.open(chosen(bench, lenses), targets.get(target.value)))
        refresh()

    with ui.row().classes("line"):
        source = ui.select([_NOW, *sorted(sources)], label="Pictures of").classes("field")
        source.bind_value(marks, "source")
        lenses = choice("Lenses", bench, "calibrations")
        target = ui.select([*targets], label="Markers of", clearable=True).classes("field")
        opener = button("Open", "photo_camera", begin)
        ui.timer(0.5, lambda: put(opener, "primary", marks.marking is None))


def _picture(marks: _MarksPage, marking: api.Marking) -> None:
    """A picture that is clicked into, and what is marked in it."""
    shown = ""  # The camera whose picture is there: another one may be chosen already
    in_turn = asyncio.Lock()  # A quick click is the next marker's

    async def click(at: events.MouseEventArguments) -> None:
        camera, at_px = shown, (at.image_x - 0.5, at.image_y - 0.5)
        async with in_turn:
            await tried(lambda: marks.click(marking, camera, at_px))

    with ui.row().classes("line"):
        ui.toggle([*marking.pictures]).props("no-caps").bind_value(marks, "camera")
        ui.input("Marker").bind_value(marks, "name")
        place = ui.input("x, y, z in the world, mm").bind_value(marks, "place").classes("field")
        place.on("keydown.enter", lambda: tried(lambda: marking.place(marks.name, marks.place)))
        ui.select([*api.MARK_KINDS], label="It is a").classes("kind").bind_value(marks, "kind")
    with ui.element("div").classes("marking"):
        image = ui.interactive_image(on_mouse=click, cross="#0008").classes("marked")
        with ui.column():
            ui.element("canvas").classes("magnifier").props("width=264 height=264")
            ui.label("What the pointer is at is enlarged here.").classes("hint")
            columns = [{"name": n, "label": n, "field": n, "align": "left"} for n in _COLUMNS]
            table = ui.table(rows=[], columns=columns).classes("marks")
            table.props("flat dense data-marks")
            table.props('no-data-label="Markers come here: name one, and click it in the picture."')
            table.on("rowClick", lambda e: marks.choose(e.args[1]["marker"]), [[], ["marker"]])

    def show() -> None:
        nonlocal shown
        if table.rows != (rows := marks.rows(marking)):
            table.rows = rows
        content = "".join(marks.drawn(*one) for one in marking.marks[marks.camera].items())
        if image.content != content:
            image.content = content
        if shown != marks.camera:
            shown = marks.camera
            image.set_source(marks.shown[shown])

    ui.timer(0.2, show)


def _steps(bench: Bench, marks: _MarksPage, marking: api.Marking) -> None:
    with ui.row().classes("line"):
        ui.select([*api.TAG_FAMILIES], label="Tags").bind_value(marks, "family")
        body = choice("Balls", bench, "bodies", newest=False)
        act("Find", "search", lambda: marks.find(marking, chosen(bench, body)))
        act("Remove", "delete", lambda: marks.remove(marking))
        act("Write marks", "save", lambda: marks.save(marking))
        act("Locate the cameras", "tune", lambda: marks.locate(marking), primary=True)
        live_label(lambda: marks.counted(marking), "hint")
        link("Report of the calibration", bench, lambda: marks.report)

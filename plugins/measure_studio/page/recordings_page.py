"""Recordings: sessions and runs that are in the folder, and what can be done with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any
from urllib.parse import quote

from nicegui import ui

from measure import api
from measure_lab import api as lab
from measure_studio import api as studio_api
from measure_studio.page import layout
from measure_studio.page.bench import Bench, Job
from measure_studio.page.layout import act, button, empty, findings_shown, kept_so, page, tried
from measure_studio.page.live_view import LiveView
from measure_studio.page.words import plain


@dataclass
class Recordings:
    """What was found of recordings; it outlives the browser's page."""

    bench: Bench
    findings: dict[Path, Sequence[Any]] = field(default_factory=dict)
    mended: dict[Path, Sequence[str]] = field(default_factory=dict)

    def check(self, session: Path) -> None:
        """Say what is wrong or weak in a recording; it waits its turn."""

        def work(job: Job) -> str:
            found = api.check(session, self.bench.registry, progress=job.progress)
            self.findings[session] = found.findings
            return f"checked {session.name}"

        self.bench.begin(f"checking {session.name}", work, waits=True)

    def mend(self, session: Path) -> None:
        """Take what is off out of a copy of a recording; it waits its turn."""
        out = session.with_name(studio_api.next_free(session.parent, f"{session.name}-mended"))

        def work(job: Job) -> str:
            found = api.mend(session, out, self.bench.registry, progress=job.progress)
            self.mended[session] = found.lines()
            if not found.changed:  # The copy is the recording itself
                rmtree(out, ignore_errors=True)
                return f"{session.name} is as it was"
            return f"{out.name} is {session.name}, mended"

        self.bench.begin(f"mending {session.name}", work, waits=True)

    def report(self, run: Path) -> None:
        """Write a run's report; it waits its turn."""

        def work(_: Job) -> str:
            lab.report(run, overwrite=True)
            return f"{run.name}: its report is written"

        self.bench.begin(f"reporting {run.name}", work, waits=True)

    def delete(self, folder: Path) -> None:
        """Delete a recording or a run."""
        self.bench.refuse_if_busy()
        studio_api.delete_recording(self.bench.folder, folder.name)


def add(bench: Bench) -> None:
    """Add the page."""
    recordings = Recordings(bench)

    @ui.page("/recordings")
    def page_of_recordings() -> None:
        with page(bench, "/recordings"):
            none = empty("Looking through the folder ...")
            there = ui.column().classes("recordings")
            listed = layout.Listed(there, partial(_row, recordings, lambda: refresh()))

        async def refresh() -> None:
            found = await tried(lambda: studio_api.recordings_in(bench.folder))
            if found is not None:
                none.text = "Recordings and runs come here: pages Body and Measure make them."
                none.set_visibility(not found)
                listed.show({(one.kind, one.folder): one for one in found})

        ui.timer(3.0, refresh)


def _row(
    recordings: Recordings, refresh: Callable[[], Any], key: tuple[str, Path]
) -> tuple[ui.element, Callable[[studio_api.Recording], None]]:
    """A recording or a run in a line: what it is, how good, and what can be done with it."""
    bench, (kind, folder) = recordings.bench, key
    name = folder.name

    async def delete() -> None:
        asked.close()
        await tried(lambda: recordings.delete(folder))
        await refresh()

    with ui.card().classes("recording").props(f'data-recording="{quote(name)}"') as card:
        with ui.dialog() as asked, ui.card():
            ui.label(f"Delete {name}, with all that is in it?")
            with ui.row():
                button("Delete it", "delete", delete, primary=True)
                button("Keep it", "undo", asked.close)
        with ui.element("div").classes("about"):
            ui.label(name).classes("text-h6 named")
            at, length, share = ui.label(), ui.label(), ui.label()
        problem = ui.label().classes("weak")
        with ui.row().classes("line"):
            if kind == "session":
                act("Check", "rule", partial(recordings.check, folder))
                act("Mend a copy", "healing", partial(recordings.mend, folder))
            else:
                file = folder / "report.html"
                made = layout.link("Report", bench, lambda: file if file.is_file() else None)
                made.classes("act")
                write = act("Write the report", "article", partial(recordings.report, folder))
                kept_so(1.0, lambda: write.set_visibility(not file.is_file()))
                button("3-D", "view_in_ar", partial(_open_view, folder))
            button("Delete", "delete", asked.open)
        said = ui.html("", sanitize=False).classes("findings")
        mended = ui.label().classes("lines").props("data-mended")

    def show(one: studio_api.Recording) -> None:
        at.text = f"{one.at:%d %b %Y, %H:%M}"
        length.text = "" if one.seconds is None else f"{one.seconds:.0f} s"
        share.text = _share(one)
        problem.text = plain(one.problem, bench.folder)
        problem.set_visibility(bool(one.problem))

    def show_found() -> None:
        lines = [plain(line, bench.folder) for line in recordings.mended.get(folder, ())]
        mended.set_text("\n".join(lines))
        mended.set_visibility(bool(lines))
        findings = recordings.findings.get(folder)
        said.set_visibility(findings is not None)
        if findings is not None:
            nothing = '<p class="good">nothing wrong, nothing weak</p>'
            said.set_content(findings_shown(findings) or nothing)

    kept_so(1.0, show_found)
    return card, show


def _share(one: studio_api.Recording) -> str:
    poses = f"{one.good} of {one.poses} poses good" if one.poses else "no pose"
    return "recording" if one.kind == "session" else poses


async def _open_view(run: Path) -> None:
    """Cameras and the way of the body, in 3-D."""
    found = await tried(lambda: studio_api.trail_of(run))
    if found is None:
        return
    cameras, places, good = found
    with ui.dialog() as shown, ui.card().classes("tile large"):
        ui.label(run.name).classes("text-h6")
        view = LiveView(cameras, places, good)
        draw = view.scene()
        button("Close", "close", shown.close)
    shown.on("hide", shown.delete)
    draw()
    shown.open()

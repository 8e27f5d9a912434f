"""Make the pictures of the set-up page: `python -m docs.studio_pictures` (needs chromium).

The page is served cameras of rendered pictures: three balls, a waved board, and markers. With
`--all FOLDER` every page is also drawn into a folder, in all sizes of window, light and dark.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from measure.session import Calibration, write_calibration
from tests.camera_server import ServedCamera, serving
from tests.chromium import Chromium
from tests.simulated.sessions import still_session
from tests.studio import test_from_nothing as new
from tests.studio import test_marks as marks
from tests.studio import waved
from tests.studio.desk import choose, go, press, studio, unfold

IMAGES = Path(__file__).parent / "images"
SIZES = {"": (1440, 900), "-tablet": (800, 1100), "-phone": (390, 844)}
SHOWN = {
    "recordings": 0,
    "cameras-phone": 320,
    "calibration-phone": 320,
    "marks-tablet": 560,
    "measure": 800,
}
"""Width in px of those that are not of the first size, or hold more than usual; 0: not shown."""
WIDTH_PX = 900
AZIMUTHS_DEG = (45.0, 80.0, 115.0, 150.0)  # Of the cameras before which the board is waved
LIVE = "document.querySelectorAll('img.live[src^=blob]').length >= 2"


def main(folder: Path | None) -> None:
    """Photograph the pages, while they measure and while a board is waved."""
    with tempfile.TemporaryDirectory() as scratch, Chromium(*SIZES[""]) as page:
        still, desk = still_session(), Path(scratch) / "my-rig"
        desk.mkdir()
        for name in ("calibration.toml", "body.toml"):
            shutil.copy(still / name, desk)
        cameras = {
            f"cam{k}": [f.read_bytes() for f in sorted((still / f"cam{k}").glob("*.jpg"))]
            for k in range(4)
        }
        with serving(_served(cameras)) as found, studio(desk, *_words(found)) as address:
            go(page, address)
            page.wait_for(LIVE, 30)
            unfold(page, "a body to look for")
            choose(page, "Body to look for", "body.toml")
            page.wait_for("document.body.innerText.includes('green, red, yellow')", 60)
            unfold(page, "a body to look for")
            page.idle(8.0)
            _take(page, "cameras", folder)
            go(page, address + "measure")
            press(page, "measure$")
            page.wait_for("document.querySelector('[data-pose]')?.innerText.includes('±')", 120)
            page.idle(3.0)
            _take(page, "measure", folder)
        _calibrate(page, Path(scratch), folder)
        _make_the_body(page, Path(scratch), folder)


def _calibrate(page: Chromium, scratch: Path, folder: Path | None) -> None:
    """A board that is waved before four cameras, and lies where the world is to be."""
    rng, rig = np.random.default_rng(0), waved.rig(AZIMUTHS_DEG)
    pictures = new.CHARUCO.pictures(rng, rig)
    cameras = _served(pictures)
    with serving(cameras) as found, studio(scratch / "set-up", *_words(found)) as address:
        go(page, address + "calibration")
        press(page, "wave the board")
        is_done = f"/calibrated/.test({new.JUDGEMENT})"
        page.wait_for(f"(/tilt|more places/.test({new.ADVICE}) || {is_done}) && {LIVE}", 120)
        _take(page, "calibration", folder)
        page.wait_for(is_done, 120)
        _take(page, "calibrated", folder)
        new.serve(cameras, {n: new.at_rest(some[0], rng) for n, some in pictures.items()})
        go(page, address + "world")
        press(page, "set the origin")
        page.wait_for("document.querySelectorAll('.over path.axis.z').length >= 4", 30)
        _take(page, "world", folder)


def _make_the_body(page: Chromium, scratch: Path, folder: Path | None) -> None:
    """Markers that are clicked, and a body that is turned, before three cameras."""
    desk, rng, true = scratch / "desk", np.random.default_rng(0), new.cameras()
    desk.mkdir()
    write_calibration(desk / "calibration.toml", Calibration(true))
    dots = {c.name: new.at_rest(new.jpeg(waved.dots(c, marks.FIELD.points)), rng) for c in true}
    cameras = _served(dots)
    with serving(cameras) as found, studio(desk, *_words(found)) as address:
        go(page, address + "marks")
        marks.open_pictures(page)
        marks.mark_the_dots(page, true)
        _take(page, "marks", folder)
        new.serve(cameras, new.ball_pictures())
        go(page, address + "body")
        new.make_the_body(page, new.Waits())
        _take(page, "body", folder)
        go(page, address + "recordings")
        page.wait_for("!!document.querySelector('[data-recording]')", 20)
        _take(page, "recordings", folder)


def _served(cameras: dict[str, list[bytes]]) -> dict[str, ServedCamera]:
    return {name: ServedCamera(some, 0.25, stamps=True) for name, some in cameras.items()}


def _words(addresses: dict[str, str]) -> list[str]:
    return [f"{name}={address}" for name, address in addresses.items()]


def _take(page: Chromium, name: str, folder: Path | None) -> None:
    """In every size of window; the docs show the first, and few of the others."""
    page.wait_for("!document.querySelector('.q-notification')", 30)
    for size, (width, height) in SIZES.items():
        for dark in (False, True):
            shown = 0 if dark else SHOWN.get(name + size, 0 if size else WIDTH_PX)
            if not folder and not shown:
                continue
            page.resize(width, height, dark)
            page.evaluate("scrollTo(0, 0)")
            page.idle(1.5)
            shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            if folder:
                cv2.imwrite(str(folder / f"{name}{size}{'-dark' * dark}.png"), shot)
            if shown:
                smaller = shown, round(height * shown / width)
                shot = cv2.resize(shot, smaller, interpolation=cv2.INTER_AREA)
                options = [cv2.IMWRITE_PNG_COMPRESSION, 9]
                cv2.imwrite(str(IMAGES / f"studio-{name}{size}.png"), shot, options)
    page.resize(*SIZES[""])


if __name__ == "__main__":
    main(Path(sys.argv[2]) if sys.argv[1:2] == ["--all"] else None)

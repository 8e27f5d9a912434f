"""Make the pictures of the set-up page: `python -m docs.studio_pictures` (needs chromium).

The page is served cameras of rendered pictures: three balls, a waved board, and markers. With
`--all FOLDER` every page is drawn into a folder, in all sizes of window, light and dark.
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
from tests.studio import waved
from tests.studio.desk import choose, go, press, studio

IMAGES = Path(__file__).parent / "images"
SIZES = {"": (1440, 900), "-tablet": (800, 1100), "-phone": (420, 800)}
SHOWN = {"cameras-phone": 320, "marks-tablet": 560, "measure": 800}
"""Width in px of those in the docs that are not of the first size, or hold more than usual."""
WIDTH_PX = 900
LIVE = "document.querySelectorAll('img.live[src^=blob]').length >= 2"
VIEWER = "[...document.querySelectorAll('.q-checkbox')].find(c => c.innerText == '3-D viewer')"


def main(folder: Path | None) -> None:
    """Photograph the pages, while they measure and while a board is waved."""
    with tempfile.TemporaryDirectory() as scratch, Chromium(*SIZES[""]) as page:
        still, desk = still_session(Path(scratch)), Path(scratch) / "my-rig"
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
            choose(page, "Body to look for", "body.toml")
            page.wait_for("document.body.innerText.includes('green, red, yellow')", 60)
            page.idle(8.0)
            _take(page, "cameras", folder)
            go(page, address + "measure")
            page.wait_for(f"!!{VIEWER}", 30)
            page.evaluate(f"{VIEWER}.click()")
            press(page, "measure$")
            page.wait_for("document.querySelector('[data-pose]')?.innerText.includes('±')", 120)
            page.idle(30.0)
            _take(page, "measure", folder)
        _set_up(page, Path(scratch), folder)


def _set_up(page: Chromium, scratch: Path, folder: Path | None) -> None:
    """A board that is waved, markers, and a body, before two cameras."""
    desk, rng, true = scratch / "set-up", np.random.default_rng(0), new.cameras()
    cameras = _served(new.board_pictures(rng))
    with serving(cameras) as found, studio(desk, *_words(found)) as address:
        go(page, address + "calibration")
        choose(page, "Board", waved.TARGET)
        press(page, "wave the board")
        page.wait_for(f"!!{new.ADVICE} && {LIVE}", 30)
        page.idle(4.0)
        _take(page, "calibration", folder)
        press(page, "stop")
        write_calibration(desk / "calibration.toml", Calibration(true))
        new.serve(cameras, {c.name: [new.jpeg(waved.dots(c, new.FIELD.points))] for c in true})
        page.idle(2.0)
        go(page, address + "marks")
        new.mark_the_dots(page, true)
        page.idle(6.0)
        _take(page, "marks", folder)
        new.serve(cameras, new.ball_pictures(scratch / "balls"))
        page.idle(2.0)
        go(page, address + "body")
        new.make_the_body(page, desk, true, scratch / "balls")
        _take(page, "body", folder)


def _served(cameras: dict[str, list[bytes]]) -> dict[str, ServedCamera]:
    return {name: ServedCamera(some, 0.25, stamps=True) for name, some in cameras.items()}


def _words(addresses: dict[str, str]) -> list[str]:
    return [f"{name}={address}" for name, address in addresses.items()]


def _take(page: Chromium, name: str, folder: Path | None) -> None:
    """In every size of window; the docs show the first, and few of the others."""
    for size, (width, height) in SIZES.items():
        for dark in (False, True):
            shown = SHOWN.get(name + size, 0 if size else WIDTH_PX)
            if not folder and (dark or not shown):
                continue
            page.resize(width, height, dark)
            page.evaluate("scrollTo(0, 0)")
            page.idle(1.5)
            shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
            if folder:
                cv2.imwrite(str(folder / f"{name}{size}{'-dark' * dark}.png"), shot)
            else:
                smaller = shown, round(height * shown / width)
                shot = cv2.resize(shot, smaller, interpolation=cv2.INTER_AREA)
                options = [cv2.IMWRITE_PNG_COMPRESSION, 9]
                cv2.imwrite(str(IMAGES / f"studio-{name}{size}.png"), shot, options)
    page.resize(*SIZES[""])


if __name__ == "__main__":
    main(Path(sys.argv[2]) if sys.argv[1:2] == ["--all"] else None)

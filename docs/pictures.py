"""Make the pictures of the documentation: `python docs/pictures.py` (needs Xvfb and chromium).

They show the session of `measure demo`: the viewer under a virtual screen, the report in a browser.
The figures of the explanation pages need neither: `python docs/figures.py`.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from measure.viewing.viewer import viewer_program

IMAGES = Path(__file__).parent / "images"
SCREEN = ":97"
WIDTH, HEIGHT = 1600, 1000


def main() -> None:
    """Measure the demonstration, photograph it, shrink the photographs."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        _measure("demo", "--out", str(folder / "demo"))
        session, run = folder / "demo/session", folder / "run"
        _measure("run", str(session), "--out", str(run), "--images", "all")
        _measure("report", str(run))
        shutil.copy(folder / "demo/demo.png", IMAGES / "demo.png")
        _shrink(_viewer(run / "run.rrd", folder / "viewer.png"), IMAGES / "viewer.jpg")
        report = (run / "report.html").as_uri()
        _shrink(_page(report, folder / "wide.png", 1200, 2300), IMAGES / "report.jpg")
        _shrink(_page(report, folder / "phone.png", 500, 1600), IMAGES / "report-phone.jpg")


def _measure(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "measure", *words], check=True)


def _park_pointer() -> None:
    """Into the screen's corner: from its middle, it would point at what the window shows there."""
    x11 = ctypes.CDLL("libX11.so.6")
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XDefaultRootWindow.restype = ctypes.c_ulong
    display = ctypes.c_void_p(x11.XOpenDisplay(SCREEN.encode()))
    root = ctypes.c_ulong(x11.XDefaultRootWindow(display))
    x11.XWarpPointer(display, ctypes.c_ulong(0), root, 0, 0, 0, 0, 0, 0)
    x11.XCloseDisplay(display)


def _viewer(recording: Path, picture: Path) -> Path:
    """The native viewer, drawn by the processor on a screen that is not there."""
    drivers = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
    size = f"{WIDTH}x{HEIGHT}"
    # So large that the window leaves its corner free.
    screen_size = f"{3 * WIDTH}x{3 * HEIGHT}x24"
    with subprocess.Popen(["Xvfb", SCREEN, "-noreset", "-screen", "0", screen_size]) as screen:
        time.sleep(1.0)
        try:
            _park_pointer()
            subprocess.run(
                [
                    viewer_program(),
                    recording,
                    "--port",
                    "auto",
                    "--window-size",
                    size,
                    "--screenshot-to",
                    picture,
                ],
                env={
                    **os.environ,
                    "DISPLAY": SCREEN,
                    "WGPU_BACKEND": "vulkan",
                    "VK_ICD_FILENAMES": str(drivers[0]) if drivers else "",
                },
                check=True,
                timeout=180,
            )
        finally:
            screen.terminate()
    return picture


def _page(address: str, picture: Path, width: int, height: int) -> Path:
    """A page as a browser draws it."""
    browser = shutil.which("chromium") or shutil.which("google-chrome") or "chromium"
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless", "--no-sandbox", "--no-first-run", "--hide-scrollbars"]
        options += ["--disable-background-networking", f"--user-data-dir={profile}"]
        options += [f"--window-size={width},{height}", "--virtual-time-budget=15000"]
        subprocess.run(
            [browser, *options, f"--screenshot={picture}", address], check=True, timeout=180
        )
    return picture


def _shrink(picture: Path, target: Path) -> None:
    """A JPEG of at most 1600 px width: these pictures are looked at, not measured."""
    image = cv2.imread(str(picture))
    scale = min(1.0, WIDTH / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), small, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()

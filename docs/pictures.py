"""Make the pictures of the documentation: `python docs/pictures.py` (needs Xvfb and chromium).

They show the rig of `measure demo` from outside, rendered, and its session: the viewer under a
virtual screen, the report in a browser.
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
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics
from measure.simulation.catalogue import WORKSPACE_MM, look_at, paper_rig, stems, webcam_scene
from measure.simulation.renderer import Renderer
from measure.simulation.scene import Capsule, Cuboid, Material, Shape, Sphere
from measure.simulation.sensor import CameraSensor
from measure.viewing.viewer import viewer_program

IMAGES = Path(__file__).parent / "images"
SCREEN = ":97"
WIDTH, HEIGHT = 1600, 1000


def main() -> None:
    """Measure the demonstration, photograph it, shrink the photographs."""
    cv2.imwrite(str(IMAGES / "rig.jpg"), _rig(), [cv2.IMWRITE_JPEG_QUALITY, 88])
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


_SHELL = Material((0.03, 0.033, 0.04), 0.04, 0.3)  # of webcams and their stands
_STEEL = Material((0.25, 0.25, 0.27), 0.3, 0.12)
_TABLE = Material((0.42, 0.36, 0.29), 0.02, 0.5)
_WALL = Material((0.55, 0.57, 0.58), 0.02, 0.8)


def _rig() -> np.ndarray:
    """The demonstration's cameras, stands and body, as a person before the table sees them."""
    eye = look_at(np.array([150.0, -1250.0, 720.0]), np.array([0.0, 0.0, 190.0]))
    matrix = np.array([[1500.0, 0, 799.5], [0, 1500.0, 449.5], [0, 0, 1.0]])
    person = Camera("person", Intrinsics((1600, 900), matrix), eye)
    scene = webcam_scene()
    down = RigidTransform.from_rotvec([0.0, 0.0, 0.0], [0.0, 0.0, -10.0])
    wall = RigidTransform.from_rotvec([0.0, 0.0, 0.0], [0.0, 900.0, 500.0])
    scene = replace(
        scene,
        cameras=(person,),
        attached=(*stems(scene.body), Capsule(np.zeros(3), np.array([0.0, 0, -210]), 6.5, _STEEL)),
        fixed=tuple(shape for camera in paper_rig() for shape in _webcam_on_its_stand(camera)),
        backdrop=(
            Cuboid(down, (4000.0, 4000.0, 20.0), _TABLE),
            Cuboid(wall, (6000.0, 20.0, 4000.0), _WALL),
        ),
        lighting=replace(scene.lighting, ambient_rgb=(0.5, 0.5, 0.52)),
        sensor=CameraSensor(blur_px=0.5),
    )
    return Renderer(scene, "person").picture(0.3)


def _webcam_on_its_stand(camera: Camera) -> Iterator[Shape]:
    """Housing, lens, post and foot where a camera stands."""
    pose, center = camera.world_from_camera, camera.center
    behind = RigidTransform.from_rotvec([0.0, 0.0, 0.0], [0.0, 0.0, -14.0])
    yield Cuboid(pose @ behind, (94.0, 30.0, 26.0), _SHELL)
    yield Sphere(center, 9.0, replace(_SHELL, albedo_rgb=(0.1, 0.12, 0.2)))
    out = center - WORKSPACE_MM
    foot = np.array([center[0], center[1], 0.0]) + 20 * out / np.linalg.norm(out) * [1, 1, 0]
    top, across, along = (np.array(arm) for arm in ((0, 0, center[2] - 20), (60, 0, 0), (0, 60, 0)))
    for start, end in (
        (foot, foot + top),
        (foot - across, foot + across),
        (foot - along, foot + along),
    ):
        yield Capsule(start, end, 5.0, _SHELL)


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

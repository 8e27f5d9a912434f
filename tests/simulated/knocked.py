"""Recordings of which a camera was turned midway: its later pictures as it would then show them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.model import Camera
from measure.session import Calibration, read_calibration, read_trajectory, write_calibration
from measure.simulation.recording import write_truth

TURN_DEG = np.array([1.2, 1.4, 0.78])
"""Rotation vector about the camera's own axes: 2 deg."""


def there_and_back(count: int, sets: int) -> list[int]:
    """Which of a recording's pictures each of so many sets shows: to its end, back, and again."""
    order = [*range(count), *range(count - 2, 0, -1)]
    return [order[k % len(order)] for k in range(sets)]


def turning(camera: Camera, turn_deg: Floats = TURN_DEG) -> Callable[[Path], bytes]:
    """Makes pictures of a camera JPEGs, as it were turned about its centre."""
    lens = camera.intrinsics
    width, height = lens.size_wh
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    turn = RigidTransform.from_rotvec(np.radians(turn_deg)).rotation
    source = lens.project(lens.unproject(pixels.astype(float)) @ turn.T)
    u, v = np.moveaxis(source.reshape(height, width, 2).astype(np.float32), -1, 0)

    def turned(picture: Path) -> bytes:
        image = cv2.remap(cv2.imread(str(picture)), u, v, cv2.INTER_CUBIC)
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    return turned


def knocked_session(
    source: Path, folder: Path, sets: int, since: int, names: tuple[str, ...], hz: float = 30.0
) -> Path:
    """A session of some cameras of another, shown there and back; cam1 turns before set `since`."""
    known = read_calibration(source / "calibration.toml")
    cameras = [known.camera(name) for name in names]
    pictures = {name: sorted((source / name).glob("*.jpg")) for name in names}
    order = there_and_back(len(pictures[names[0]]), sets)
    turned = turning(known.camera("cam1"))
    later = {k: turned(pictures["cam1"][k]) for k in {*order[since:]}}
    for name in names:
        (folder / name).mkdir(parents=True)
        for number, k in enumerate(order):
            knocked = name == "cam1" and number >= since
            data = later[k] if knocked else pictures[name][k].read_bytes()
            (folder / name / f"{number:06d}.jpg").write_bytes(data)
        stamps = [f"{number},{number / hz:.9f}" for number in range(sets)]
        (folder / f"{name}.csv").write_text("\n".join(["frame,time_s", *stamps]) + "\n")
    write_calibration(folder / "calibration.toml", Calibration(tuple(cameras)))
    shutil.copy(source / "body.toml", folder)
    times_s = np.loadtxt(source / "cam0.csv", delimiter=",", skiprows=1)[:, 1]
    shown = read_trajectory(source / "truth.csv").at(times_s[order])
    write_truth(folder / "truth.csv", np.arange(sets) / hz, shown)
    tables = [
        f'[[cameras]]\nname = "{n}"\nimages = "{n}/*.jpg"\ntimestamps = "{n}.csv"\n' for n in names
    ]
    head = '[session]\nbody = "body.toml"\ncalibration = "calibration.toml"\ntruth = "truth.csv"\n'
    (folder / "session.toml").write_text("\n".join([head, *tables]))
    return folder

"""A small recording on disk, made anew for each test, to be broken in every way."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

SIZE_WH = (64, 48)

BODY = """\
name = "triangle"

[[balls]]
name = "green"
color = "green"
center_mm = [38.0, 0.0, 0.0]
radius_mm = 20.0

[[balls]]
name = "yellow"
color = "yellow"
center_mm = [0.0, 38.0, 0.0]
radius_mm = 20.0

[[balls]]
name = "red"
color = "red"
center_mm = [-38.0, 0.0, 0.0]
radius_mm = 20.0
"""


@dataclass
class Recording:
    """A session folder and the means to change it."""

    path: Path

    def replace(self, file: str, old: str, new: str) -> None:
        text = (self.path / file).read_text()
        assert old in text, f"{old!r} is not in {file}"
        (self.path / file).write_text(text.replace(old, new, 1))

    def stamp(self, camera: str, times: list[float], frames: list[int] | None = None) -> None:
        frames = list(range(len(times))) if frames is None else frames
        rows = "".join(f"{f},{t}\n" for f, t in zip(frames, times, strict=True))
        (self.path / f"{camera}.csv").write_text("frame,time_s\n" + rows)


def jpeg(level: int, size_wh: tuple[int, int] = SIZE_WH) -> bytes:
    """A picture whose grey level tells which frame it is."""
    done, data = cv2.imencode(".jpg", np.full((size_wh[1], size_wh[0], 3), level, np.uint8))
    assert done
    return bytes(data)


def write_recording(path: Path, cameras: int = 3, frames: int = 6) -> Recording:
    """Frames at 10 Hz whose grey level is 20 times the frame number (modulo 12)."""
    recording = Recording(path)
    path.mkdir(parents=True, exist_ok=True)
    session = '[session]\nname = "small"\nbody = "body.toml"\ncalibration = "calibration.toml"\n'
    calibration = ""
    for i in range(cameras):
        name = f"cam{i}"
        session += f'\n[[cameras]]\nname = "{name}"\nimages = "{name}/*.jpg"\n'
        session += f'timestamps = "{name}.csv"\n'
        calibration += (
            f'[[cameras]]\nname = "{name}"\nsize_wh = [{SIZE_WH[0]}, {SIZE_WH[1]}]\n'
            "matrix = [[70.0, 0.0, 31.5], [0.0, 70.0, 23.5], [0.0, 0.0, 1.0]]\n"
            "distortion = []\nquat_wxyz = [0.0, 1.0, 0.0, 0.0]\n"
            f"translation_mm = [{200.0 * i}, 0.0, 500.0]\n\n"
        )
        (path / name).mkdir(exist_ok=True)
        for k in range(frames):
            (path / name / f"{k:06d}.jpg").write_bytes(jpeg(20 * (k % 12)))
        recording.stamp(name, [0.1 * k for k in range(frames)])
    (path / "session.toml").write_text(session)
    (path / "calibration.toml").write_text(calibration)
    (path / "body.toml").write_text(BODY)
    return recording


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return write_recording(tmp_path / "rec")

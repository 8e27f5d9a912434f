"""What larger pictures, more cameras and bodies cost: `python -m benchmarks.scale SESSION`.

Copies of a session are made whose pictures are of 720p, 1080p and 4K, with noise of two levels as
a sensor has, and a calibration to match. Measured of each, as CPU time: reading and decoding a
picture; detecting a ball in a picture where it is expected; all else of a frame set of one body;
and `measure run` on two cores, images not logged. From these parts is modelled, and printed as
such, what `--cameras` cameras and `--bodies` bodies of as many balls need: the CPU time of a frame
set, and how many of them 2, 4 and 8 cores measure in a second at the share of the cores that the
run on two made use of, but no more than one core does of what is not decoding.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.command import run_command
from benchmarks.tables import markdown
from benchmarks.tracking_timing import one_core, stages, whole_run
from benchmarks.trial import reference_s
from measure.arrays import Bytes
from measure.model import Camera
from measure.session import (
    Calibration,
    Session,
    decode_picture,
    open_session,
    read_calibration,
    read_picture,
    write_calibration,
)

SIZES = {"720p": (1280, 720), "1080p": (1920, 1080), "4K": (3840, 2160)}
CORES = (2, 4, 8)
HEAD = (
    *("pictures", "cvtColor ms", "decode ms", "a ball us", "the rest ms", "run: CPU ms"),
    *("x cvtColor", "frame sets/s", "modelled: CPU ms", *(f"/s on {n}" for n in CORES)),
)
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 90)
_NOISE = 2.0  # Levels
_DECODED = 24  # Pictures whose decoding is timed
_HELD = 16  # Those in memory at a time, as in a run of four cameras: what is freed is used again


@dataclass(frozen=True)
class Cost:
    """CPU time of the parts, in s."""

    reference: float  # one cv2.cvtColor of a picture of 720p
    decode: float  # of a picture, with reading
    ball: float  # detecting one in one picture
    rest: float  # of a frame set of one body
    whole: float  # of a frame set in `measure run`
    used: float  # cores of two that it made use of

    def modelled(self, cameras: int, body_balls: int, bodies: int) -> tuple[float, float]:
        """Of a frame set: all, and what is not decoding."""
        tracking = bodies * (cameras * body_balls * self.ball + self.rest)
        return cameras * self.decode + tracking, tracking


def resized(folder: Path, out: Path, size_wh: tuple[int, int]) -> Path:
    """A copy of a session with pictures of a size."""
    out.mkdir()
    random = np.random.default_rng(1)
    for name in ("session.toml", "body.toml"):
        (out / name).write_text((folder / name).read_text("utf-8").replace('truth = "t', '#"'))
    for file in folder.glob("*.csv"):
        (out / file.name).write_bytes(file.read_bytes())
    known = read_calibration(folder / "calibration.toml")
    larger = tuple(_larger(one, size_wh) for one in known.cameras)
    write_calibration(out / "calibration.toml", Calibration(larger, known.provenance))
    noise = random.normal(0.0, _NOISE, (*size_wh[::-1], 3)).astype(np.float32)
    for file in sorted(folder.glob("*/*.jpg")):
        picture = cv2.resize(read_picture(file), size_wh, interpolation=cv2.INTER_CUBIC)
        noisy = picture + np.roll(noise, int(random.integers(len(noise))), axis=0)
        target = out / file.parent.name / file.name
        target.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(target), np.clip(np.rint(noisy), 0, 255).astype(np.uint8), _JPEG)
    return out


def _larger(camera: Camera, size_wh: tuple[int, int]) -> Camera:
    """The same camera with larger pictures; pixel centres are at integers."""
    lens = camera.intrinsics
    scale = size_wh[0] / lens.size_wh[0]
    grown = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
    lens = replace(lens, size_wh=size_wh, matrix=grown @ lens.matrix, covariance=None)
    return replace(camera, intrinsics=lens)


def measured(folder: Path, frames: int, repeats: int) -> Cost:
    """The parts of a session, and the whole."""
    with open_session(folder) as session, one_core():
        decode = _decoding_s(session, repeats)
        _, table, _ = stages(session, "precise", repeats)
        views = len(session.cameras) * len(session.body.balls)
    small = np.zeros((720, 1280, 3), np.uint8)
    reference = min(reference_s(small) for _ in range(repeats))
    wall_s, cpu_s, _ = whole_run(folder, "precise", frames)
    rest = float(table[-1] - table[0])
    return Cost(reference, decode, float(table[0]) / views, rest, cpu_s, cpu_s / wall_s)


def _decoding_s(session: Session, repeats: int) -> float:
    files = [file for stream in session.streams.values() for file in stream.files][:_DECODED]
    spent, held = [], deque[Bytes](maxlen=_HELD)
    for _ in range(repeats):
        start = time.thread_time()
        for file in files:
            held.append(decode_picture(file.read_bytes(), str(file)))
        spent.append((time.thread_time() - start) / len(files))
    return min(spent)


def rows(folder: Path, cameras: int, bodies: int, frames: int) -> Iterator[list[str]]:
    """A row for each size."""
    with tempfile.TemporaryDirectory() as scratch:
        for name, size_wh in SIZES.items():
            copy = resized(folder, Path(scratch) / name, size_wh)
            with open_session(copy) as session:
                balls = len(session.body.balls)
            cost = measured(copy, frames, repeats=3)
            all_s, serial_s = cost.modelled(cameras, balls, bodies)
            paces = [min(n * cost.used / 2 / all_s, 1 / serial_s) for n in CORES]
            numbers = [1e3 * cost.reference, 1e3 * cost.decode, 1e6 * cost.ball, 1e3 * cost.rest]
            numbers += [1e3 * cost.whole, cost.whole / cost.reference, cost.used / cost.whole]
            yield [name, *(f"{n:.3g}" for n in (*numbers, 1e3 * all_s, *paces))]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.scale", description=__doc__)
    parser.add_argument("session", type=Path, help="a session of JPEG files in one folder")
    parser.add_argument("--cameras", type=int, default=8, help="cameras modelled")
    parser.add_argument("--bodies", type=int, default=6, help="bodies modelled")
    parser.add_argument("--frames", type=int, default=400, help="frame sets of the whole run")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    print(markdown(HEAD, [*rows(given.session, given.cameras, given.bodies, given.frames)]))


if __name__ == "__main__":
    run_command(main)

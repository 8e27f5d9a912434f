"""What each stage of a cheap camera costs: `python -m benchmarks.pictures --frames 10`.

Own scenes (balls free, and half hidden), each under four other pairs of lamps and moving otherwise,
are rendered with a sensor chain to which one stage after the other is added: what a table's row
has more than the row above is what that stage costs, whatever measures its pictures.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import pose_error, rms, truth_of
from benchmarks.tables import markdown
from measure.api import load_profile, measure_session
from measure.arrays import Floats
from measure.host import Registry
from measure.session import open_session
from measure.simulation import Scene, write_session
from measure.simulation.catalogue import WEBCAM, webcam_scene
from measure.simulation.sensor import CameraSensor
from tests.simulated.catalogue import occluded_scene

_SEEDS = (11, 12, 13, 14)
_PNG = replace(WEBCAM, bayer=False, electrons=0.0, read_noise=0.0, encoding="png")
_NOISY = replace(_PNG, electrons=WEBCAM.electrons, read_noise=WEBCAM.read_noise)
_MOSAIC = replace(_NOISY, bayer=True)
_CHEAP = replace(WEBCAM, blur_px=0.9, sharpen=0.8, quality=80)
STAGES: dict[str, CameraSensor] = {
    "blur of 0.6 px and sRGB, no noise": _PNG,
    "and noise": _NOISY,
    "and a mosaic": _MOSAIC,
    "and JPEG quality 90, colour at full resolution": replace(WEBCAM, chroma="444"),
    "and colour at half the width (4:2:2)": replace(WEBCAM, chroma="422"),
    "and at half the height, too (4:2:0)": WEBCAM,
    "and blur of 0.9 px, sharpening, quality 80": _CHEAP,
}


def main() -> None:
    """Print a row per stage."""
    parser = argparse.ArgumentParser(prog="benchmarks.pictures", description=__doc__)
    parser.add_argument("--frames", type=int, default=10, help="sets of each recording")
    given = parser.parse_args()
    head = ("pictures", "still mm", "still deg", "half hidden mm", "half hidden deg")
    rows = []
    for name, sensor in STAGES.items():
        cells = [
            f"{value:.3f}"
            for of_seed in (webcam_scene, occluded_scene)
            for value in typical([replace(of_seed(s), sensor=sensor) for s in _SEEDS], given.frames)
        ]
        rows.append((name, *cells))
        print(*rows[-1], flush=True)
    print(markdown(head, rows))


def typical(scenes: list[Scene], frames: int) -> Floats:
    """Geometric means over scenes of the RMS errors of position (mm) and rotation (deg)."""
    return np.exp(np.mean(np.log(list(_errors(scenes, frames))), axis=0))


def _errors(scenes: list[Scene], frames: int) -> Iterator[tuple[float, float]]:
    profile, registry = load_profile("precise"), Registry.discover()
    for scene in scenes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "session"
            write_session(scene, np.arange(frames) / 30.0, path)
            truth = truth_of(path)
            with open_session(path) as session:
                measured = [one for _, one in measure_session(session, profile, registry)]
            off = np.array([pose_error(one, truth) for one in measured])
            yield rms(off[:, :3]), float(np.degrees(rms(off[:, 3:])))


if __name__ == "__main__":
    run_command(main)

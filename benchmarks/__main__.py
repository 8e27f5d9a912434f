"""Print the table; with --out, write it as a page of the documentation."""

from __future__ import annotations

import argparse
import platform
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, repeat
from multiprocessing import get_context
from pathlib import Path

import cv2

from benchmarks.methods import METHODS
from benchmarks.off_axis import BINS_DEG, off_axis_recordings, off_axis_rows
from benchmarks.recordings import own_recordings, recordings_beside
from benchmarks.tables import markdown, section
from measure.results import versions
from measure.simulation import scene_catalogue

WORDS = """# Benchmarks

Every method on every recording, with one default setting throughout. Made by

<!-- skip: half an hour -->
```bash
python -m benchmarks --frames 8 --jobs 2 --out docs/benchmarks.md
```

- *centre px* (RMS per axis), *position mm* and *rotation deg* (RMS) are over what has been found:
  read them with *no pose %*, the share of frame sets without a pose, and *wrong %*, of those
  that the method believes although they are more than 2 mm off.
- *x bound* is the position's RMS over its Cramér-Rao bound, the least that pixel noise alone
  allows with the contrast, the noise and the visible outlines of that recording (less than a
  micrometre): all else is systematic error.
- *in 95 %* is the share of poses whose reported 95 % ellipsoid holds the true position. Frame
  sets of one recording err alike; see [what the uncertainty means](explanation/uncertainty.md)
  for what more recordings say.
- *first* and *later* are the CPU time of the first frame set (search) and the median of the
  others, decoding apart, as multiples of one `cv2.cvtColor(BGR2HSV)` of one picture, timed in
  turn with them.

`own` recordings are rendered by `measure.simulation`, their calibration exact; the others by a
path tracer that is not part of the program, and appear where they are at hand.

"""
OFF_AXIS = """## Off the optical axis

How far detected centres lie too far out, in px (median), by the angle between line of sight and
optical axis, on the plain black scene with every camera turned aside by every angle, all ways.

"""


def _options() -> argparse.Namespace:
    """What the command line says; a filter that nothing passes is refused."""
    methods = ", ".join(method.name for method in METHODS)
    parser = argparse.ArgumentParser(
        prog="benchmarks",
        description="Print how accurate, how reliable and how fast every method is on every "
        "recording; with --out, write it as a page of the documentation.",
        epilog=f"methods: {methods}; recordings: the rendered sessions beside the project, where "
        "they are at hand, the scenes of measure.simulation, and off-axis",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=24, help="frame sets per own scene")
    parser.add_argument("--cache", type=Path, help="folder that keeps the rendered scenes")
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    parser.add_argument("--methods", default="", help="methods whose name contains this")
    parser.add_argument("--jobs", type=int, default=1, help="recordings measured side by side")
    parser.add_argument("--out", type=Path, help="write the tables to this page")
    given = parser.parse_args()
    if not any(given.methods in method.name for method in METHODS):
        parser.error(f"--methods {given.methods}: there is {methods}")
    known = [*recordings_beside(), *(f"own {name}" for name in scene_catalogue()), "off-axis"]
    if not any(given.only in name for name in known):
        parser.error(f"--only {given.only}: there is {', '.join(known)}")
    if given.frames < 2:
        parser.error(f"--frames {given.frames}: at least 2 are needed, one of them tracked")
    if given.jobs < 1:
        parser.error(f"--jobs {given.jobs}: at least 1 is needed")
    return given


def main() -> None:
    """Run all trials."""
    given = _options()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.cache or Path(scratch)
        recordings = {**recordings_beside(), **own_recordings(folder, given.frames)}
        chosen = {name: path for name, path in recordings.items() if given.only in name}
        with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
            parts = list(pool.map(section, chosen, chosen.values(), repeat(given.methods)))
        if given.only in "off-axis":
            rows = off_axis_rows(
                off_axis_recordings(folder, max(given.frames // 4, 1)), given.methods
            )
            head = ("method", *(f"{a:.0f}-{b:.0f} deg" for a, b in pairwise(BINS_DEG)))
            parts.append(OFF_AXIS + markdown(head, rows))
    text = "\n".join(parts)
    print(text)
    if given.out is not None:
        given.out.write_text(WORDS + text + _footer(), encoding="utf-8")


def _footer() -> str:
    listed = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"\nWith {listed}; {platform.machine()}, {platform.system()}.\n"


if __name__ == "__main__":
    main()

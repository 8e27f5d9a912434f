"""Print the table; with --out, write it as a page of the documentation."""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise, repeat
from multiprocessing import get_context
from pathlib import Path

import cv2

from benchmarks.methods import METHODS
from benchmarks.off_axis import BINS_DEG, off_axis_recordings, off_axis_rows
from benchmarks.recordings import own_recordings, recordings_beside
from benchmarks.trial import Trial, bounds_of, run_trial
from measure.host import Registry
from measure.results import versions
from measure.session import open_session, read_trajectory
from measure.simulation import scene_catalogue

HEAD = (
    "method",
    "centre px",
    "position mm",
    "rotation deg",
    "x bound",
    "no pose %",
    "wrong %",
    "flagged %",
    "in 95 %",
    "first x",
    "later x",
)
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
            parts = list(pool.map(_part, chosen, chosen.values(), repeat(given.methods)))
        if given.only in "off-axis":
            rows = off_axis_rows(
                off_axis_recordings(folder, max(given.frames // 4, 1)), given.methods
            )
            head = ("method", *(f"{a:.0f}-{b:.0f} deg" for a, b in pairwise(BINS_DEG)))
            parts.append(OFF_AXIS + _markdown(head, rows))
    text = "\n".join(parts)
    print(text)
    if given.out is not None:
        given.out.write_text(WORDS + text + _footer(), encoding="utf-8")


def _part(name: str, path: Path, methods: str) -> str:
    """The section on one recording."""
    cv2.setNumThreads(1)
    return f"## {name}\n\n" + _markdown(HEAD, list(_rows(name, path, methods)))


def _rows(name: str, path: Path, methods: str) -> Iterator[tuple[str, ...]]:
    registry = Registry.discover()
    truth = read_trajectory(path / "truth.csv")
    with open_session(path) as session:
        bounds = bounds_of(session, truth)
    for method in METHODS:
        if methods in method.name:
            with open_session(path) as session:
                trial = run_trial(method, session, truth, registry, bounds)
            row = (method.name, *_cells(trial))
            print("  ".join((name, *row)), file=sys.stderr, flush=True)
            yield row


def _cells(trial: Trial) -> tuple[str, ...]:
    return (
        f"{trial.center_px:.3f}",
        f"{trial.position_mm:.3f}",
        f"{trial.rotation_deg:.3f}",
        f"{trial.over_bound:.0f}",
        f"{100 * trial.missing:.0f}",
        f"{100 * trial.wrong:.0f}",
        f"{100 * trial.flagged:.0f}",
        f"{100 * trial.covered:.0f}",
        f"{trial.first_ref:.1f}",
        f"{trial.later_ref:.1f}",
    )


def _markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" if i < 1 else "---:" for i in range(len(head))), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _footer() -> str:
    listed = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"\nWith {listed}; {platform.machine()}, {platform.system()}.\n"


if __name__ == "__main__":
    main()

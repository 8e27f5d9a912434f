"""Print the table; with --out, write it as a page of the documentation."""

from __future__ import annotations

import argparse
import platform
import tempfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import cv2

from benchmarks.command import run_command
from benchmarks.methods import DEFAULT, METHODS
from benchmarks.off_axis import BINS_DEG, off_axis_recordings, off_axis_rows
from benchmarks.photographs import HEAD, marked_balls, photograph_rows
from benchmarks.recordings import (
    ALTERED,
    RELIT,
    UNUSUAL,
    alter_all,
    altered_recordings,
    recordings_beside,
    render_all,
    rendered_scenes,
)
from benchmarks.scale import HEAD as SCALE_HEAD
from benchmarks.scale import rows as scale_rows
from benchmarks.stated import HEAD as STATED_HEAD
from benchmarks.stated import stated_rows
from benchmarks.tables import FIGURES, Rows, markdown, measured_rows, typical, typical_by
from measure.processes import processes
from measure.results import versions

WORDS = """# Benchmarks

Every method on every recording, with one default setting throughout. Made by

<!-- skip: half an hour -->
```bash
python -m benchmarks --frames 8 --jobs 2 --out docs/benchmarks.md
```

- *centre px* (RMS per axis), *position mm* and *rotation deg* (RMS) are over what has been found:
  read them with *no pose %*, the share of frame sets without a pose, and *wrong %*, of those
  that the method does not flag although they are more than 2 mm off.
- *x bound* is the position's RMS over its Cramér-Rao bound, the least that pixel noise allows with
  that recording's contrast and visible outlines (under a micrometre): the rest is systematic.
- *in 95 %* is the share of poses whose reported 95 % ellipsoid holds the true position; frame sets
  of one recording err alike. See [what the uncertainty means](explanation/uncertainty.md).
- *typical* rows are geometric means, and means of shares. `--only NAME` prints each recording
  whose name contains it, by every method.
- *first* and *later* are the CPU time of the first frame set (search) and the median of the rest,
  without decoding and burn-in, as multiples of one `cv2.cvtColor(BGR2HSV)`, timed in turn with it.

`own` and unusual recordings are rendered by `measure.simulation`, their calibration exact; the
others by a path tracer that is not part of the program, and appear where they are available.

"""
ALL_METHODS = """## All methods

"""
STATED = """## Stated and real errors

Whether poses err as their covariances state: *NEES* is the mean normalised squared error; above 1
the covariance is too small. This table alone: `python -m benchmarks.stated [--own]`.

"""
OFF_AXIS = """## Off the optical axis

How far detected centres lie too far out, in px (median), by the angle between line of sight and
optical axis, on the plain black scene with every camera turned aside by every angle, all ways.

"""
RELIT_SCENES = """## Own scenes in other light

Seven kinds of own scene, each under four other pairs of lamps, in other rooms, moving otherwise,
measured with the default profile. Frame sets of one recording err alike: only many lights say how
far off any will be, and whether *in 95 %* is 95 %.

"""
UNUSUAL_PICTURES = """## Unusual pictures

Scenes with two or three things out of the ordinary at once, measured with the default profile
(with others by `--only unusual --methods NAME`). *in 95 %* says whether results know how good
they are, where they are less good.

"""
ALTERED_RECORDINGS = """## Altered recordings

The path tracer's recordings as other cameras would have taken them (`benchmarks/altered.py`),
measured with the default profile: more contrast than the standard's tone curve has, sharpened with
a strongly bent curve, overexposed, dim, defocused; as cheap webcams do, with lateral colour of half
a pixel at the corners, vignetted, smoothed by a median; and with radii in the body file that are
1 % too large, or up and down by 0.5 % in turn. One alone: `--only "altered still lateral"`.

"""
PHOTOGRAPHS = """## Photographs

Real balls on photographs, with outlines marked by hand to 0.15-0.4 px: {balls} of 9 to {most:.0f}
px radius, foam, perforated and glossy. Searched in whole pictures from nothing, then measured where
they are expected, 1.8 px aside: the share found within a quarter of the radius, RMS error of
centres, and how many 95 % regions, with the marks' own error, hold the marks. This table alone:
`python -m benchmarks --only photographs`.

"""
SCALE = """## Scale

The recording `still` with its pictures enlarged, and noise as of a sensor (`benchmarks/scale.py`):
CPU time of reading and decoding a picture, of detecting one ball in one picture, and of all else of
a frame set; of a frame set of four cameras and one body in `measure run`, and how many it measures
in a second on two cores. What follows is modelled from these parts, not measured: eight cameras and
six bodies of three balls. This table alone: `python -m benchmarks --only scale`.

"""
APART = {ALTERED: ALTERED_RECORDINGS, RELIT: RELIT_SCENES, UNUSUAL: UNUSUAL_PICTURES}
"""Prefixes of recordings with a table of their own, and the text above it."""
KINDS: dict[str, Callable[[str], str]] = {
    ALTERED: lambda name: name.split()[-1],
    RELIT: lambda name: name.split()[0],
    UNUSUAL: lambda name: name,
}
"""What of a recording's name says which others are like it."""
IN_EVERY_RECORDING = ("paper profile", DEFAULT)
"""Methods with a row for each recording; of the others the page has what is typical."""


def _options() -> argparse.Namespace:
    """The options of the command line; a filter that matches nothing is refused."""
    methods = ", ".join(method.name for method in METHODS)
    parser = argparse.ArgumentParser(
        prog="benchmarks",
        description="Print how accurate, how reliable and how fast every method is on every "
        "recording; with --out, write it as a page of the documentation.",
        epilog=f"methods: {methods}; recordings: the rendered sessions beside the project, where "
        "they are at hand, these 'altered', 'own', 'relit' and 'unusual' scenes of "
        "measure.simulation, stated, photographs and scale, where they are at hand, and off-axis",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--frames", type=int, default=24, help="frame sets per scene")
    parser.add_argument("--cache", type=Path, help="folder that keeps the rendered scenes")
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    parser.add_argument(
        "--methods",
        default="",
        help="methods whose name contains this; if it is empty, all but for relit and unusual "
        f"scenes and altered recordings, which the {DEFAULT} alone measures",
    )
    parser.add_argument("--jobs", type=int, default=1, help="recordings measured side by side")
    parser.add_argument("--out", type=Path, help="write the tables to this page")
    given = parser.parse_args()
    if not any(given.methods in method.name for method in METHODS):
        parser.error(f"--methods {given.methods}: no method is called so; there are {methods}")
    known = [
        *recordings_beside(),
        *altered_recordings(),
        *rendered_scenes(),
        "stated",
        "photographs",
        "off-axis",
        "scale",
    ]
    if not any(given.only in name for name in known):
        names = ", ".join(known)
        parser.error(f"--only {given.only}: no recording is called so; there are {names}")
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
        text = "\n".join(_sections(given, folder))
    print(text)
    if given.out is not None:
        given.out.write_text(WORDS + text + _footer(), encoding="utf-8")


def _measured(given: argparse.Namespace, folder: Path) -> dict[str, Rows]:
    """The rows of every recording that is asked for, rendered or altered if it has to be."""
    paths = {name: path for name, path in recordings_beside().items() if given.only in name}
    wanted = {name: how for name, how in altered_recordings().items() if given.only in name}
    paths |= alter_all(wanted, folder)
    scenes = {name: scene for name, scene in rendered_scenes().items() if given.only in name}
    paths |= render_all(scenes, folder, given.frames)
    methods = [
        given.methods or (DEFAULT if name.startswith(tuple(APART)) else "") for name in paths
    ]
    with processes(given.jobs) as pool:
        rows = list(pool.map(measured_rows, paths, paths.values(), methods))
    return dict(zip(paths, rows, strict=True))


def _sections(given: argparse.Namespace, folder: Path) -> Iterator[str]:
    """The page's sections on what is asked for."""
    whole: Rows = []
    apart: dict[str, Rows] = {kind: [] for kind in APART}
    for name, rows in _measured(given, folder).items():
        kind = next((kind for kind in APART if name.startswith(kind)), None)
        if kind is None:
            whole += [(name, *row) for row in rows]
        else:
            apart[kind] += [(name.removeprefix(kind), *row) for row in rows]
    if whole:
        each = [row for row in whole if given.only or row[1] in IN_EVERY_RECORDING]
        yield ALL_METHODS + markdown(("recording", "method", *FIGURES), each + typical(whole))
    for kind, rows in apart.items():
        if rows:
            shown = rows if given.only else typical_by(rows, KINDS[kind])
            yield APART[kind] + markdown(("recording", "method", *FIGURES), shown)
    if given.only in "stated" and (beside := recordings_beside()):
        yield STATED + markdown(STATED_HEAD, [*stated_rows(beside)])
    if given.only in "photographs" and (balls := marked_balls()):
        most = max(ball.radius_px for ball in balls)
        rows = [row for row in photograph_rows(balls) if given.methods in row[0]]
        yield PHOTOGRAPHS.format(balls=len(balls), most=most) + markdown(HEAD, rows)
    if given.only in "scale" and (still := recordings_beside().get("still")):
        yield SCALE + markdown(SCALE_HEAD, [*scale_rows(still, cameras=8, bodies=6, frames=400)])
    if given.only in "off-axis":
        turned = off_axis_recordings(folder, max(given.frames // 4, 1))
        head = ("method", *(f"{a:.0f}-{b:.0f} deg" for a, b in pairwise(BINS_DEG)))
        yield OFF_AXIS + markdown(head, off_axis_rows(turned, given.methods))


def _footer() -> str:
    listed = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"\nWith {listed}; {platform.machine()}, {platform.system()}.\n"


if __name__ == "__main__":
    run_command(main)

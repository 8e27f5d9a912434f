"""`measure body`: a body file from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import FIELDS, InjectedRegistry
from measure.session import write_body

_COLUMNS = ("from", "to", "distance_mm", "sd_mm")


def body(
    session: Path,
    /,
    *,
    search: Annotated[api.BodySearch, FIELDS],
    sample: tuple[str, ...] = (),
    out: OutFile,
    overwrite: Overwrite = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Write a body file from a recording of the balls.

    The body is turned and carried through the workspace. Balls of the common colours are found in
    whole pictures, and their places adjusted to all of them; the cameras give the scale.

    Args:
        session: the recording; it needs no body file, and one that it names is not read.
        sample: NAME=PICTURE:U,V, the colour of a ball that is not found by itself: a pixel on it in
            a picture of the recording. It is searched beside the common colours. May be repeated.
        out: the body file to write.
    """
    learnt = api.learnt_colors(sample)
    with api.output(out, overwrite) as file, console.progress("looking") as progress:
        found = api.find_body(session, registry, search, progress, learnt=learnt)
        write_body(file, found.body, comment=f"by `measure body`; {_words(found)}")
    if json:
        _print_json(found, out)
    else:
        _print(found, out)


def _distances(found: api.FoundBody) -> list[tuple[str, str, float, float]]:
    return [(a, b, mm, sd) for (a, b), (mm, sd) in found.distances.items()]


def _print_json(found: api.FoundBody, out: Path) -> None:
    values = {
        "output": out,
        "frame": found.frame,
        "frame_sets": found.frame_sets,
        "rms_px": found.rms_px,
        "tolerance_mm": found.body.tolerance_mm,
        "seen_radii_mm": found.seen_radii,
        "left_out": found.left_out,
        "distances": [dict(zip(_COLUMNS, row, strict=True)) for row in _distances(found)],
    }
    console.print_json(values)


def _print(found: api.FoundBody, out: Path) -> None:
    console.print_table(_COLUMNS, _distances(found))
    for line in found.left_out:
        console.print_text(line)
    console.print_text(f"wrote {out}: {_words(found)}")


def _words(found: api.FoundBody) -> str:
    return (
        f"{len(found.body.balls)} balls from {found.frame_sets} frame sets, each coordinate known "
        f"to {found.body.tolerance_mm:.3f} mm, reprojection error {found.rms_px:.2f} px RMS; "
        f"frame: {found.frame}"
    )

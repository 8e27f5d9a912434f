"""`measure body`: a body file from a recording."""

from __future__ import annotations

from pathlib import Path

from measure import api
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import InjectedRegistry
from measure.session import write_body


def body(
    session: Path,
    /,
    *,
    radius_mm: float,
    like: Path | None = None,
    origin: str | None = None,
    out: OutFile,
    overwrite: Overwrite = False,
    calibration: Path | None = None,
    profile: str = "precise",
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Write a body file from a recording in which the balls are seen.

    The body is turned and carried through the workspace. Balls of the common colours are found in
    whole pictures, and their places adjusted to all of them; the cameras give the scale.

    Args:
        session: the recording; it needs no body file, and one that it names is not read.
        radius_mm: radius of each ball.
        like: body file with the balls' names and colours and the frame to use; needed where two
            balls have one colour, or one that has no common name.
        origin: ball to put the origin at; the centroid of all if omitted.
        out: the body file to write.
        calibration: a calibration file to use instead of the session's own.
        profile: how to measure the session, by name or TOML file.
    """
    with api.output(out, overwrite) as file, console.progress("looking") as progress:
        found = api.find_body(
            session, registry, radius_mm, like, origin, profile, calibration, progress
        )
        write_body(file, found.body)
    rows = [(a, b, mm, sd) for (a, b), (mm, sd) in found.distances.items()]
    if json:
        keys = ("from", "to", "distance_mm", "sd_mm")
        values = {
            "output": out,
            "frame": found.frame,
            "frame_sets": found.frame_sets,
            "rms_px": found.rms_px,
            "tolerance_mm": found.body.tolerance_mm,
            "seen_radii_mm": found.seen_radii,
            "distances": [dict(zip(keys, row, strict=True)) for row in rows],
        }
        console.print_json(values)
        return
    console.print_table(("from", "to", "distance_mm", "sd_mm"), rows)
    console.print_text(f"frame: {found.frame}")
    console.print_text(
        f"wrote {out}: {len(found.body.balls)} balls from {found.frame_sets} frame sets, each "
        f"coordinate known to {found.body.tolerance_mm:.3f} mm; what is left in the pictures "
        f"{found.rms_px:.2f} px RMS"
    )

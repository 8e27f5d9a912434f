"""`measure detect`: does it see my balls?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from measure import api
from measure.api import SeenPicture
from measure.cli import console
from measure.cli.console import JsonFlag, OutFile, Overwrite
from measure.cli.options import FIELDS, DetectorOptions, InjectedRegistry
from measure.errors import ConfigError


def detect(
    *pictures: Path,
    body: Path,
    lens: Annotated[api.Lens, FIELDS] = api.Lens(),
    expect: tuple[str, ...] = (),
    method: DetectorOptions = DetectorOptions(),
    out: OutFile | None = None,
    sample: tuple[str, ...] = (),
    write_body: Path | None = None,
    overwrite: Overwrite = False,
    json: JsonFlag = False,
    registry: InjectedRegistry,
) -> None:
    """Show what the detector sees in single pictures.

    No recording is needed, and no calibration: the focal length is found from the outlines of the
    balls, taken from the picture's Exif tags, or assumed; the command prints which. The whole
    picture is searched for balls of 7 px radius and more, unless you state where a ball is
    expected. Pixels are counted as a viewer shows the picture.

    Args:
        pictures: picture files of one camera.
        body: the body's file: the balls' colours and radii.
        expect: BALL=U,V,R: look for the ball round (U, V) px with radius R px; may be repeated.
        out: folder for copies of the pictures with the balls drawn in.
        sample: BALL=U,V: a pixel on the ball, from which its colour is taken; may be repeated.
        write_body: a body file to write, with the colours that the balls have in the picture: those
            of `--sample`, else of `--expect`, inside their outlines.
    """
    if not pictures:
        raise ConfigError("no picture is given: measure detect PICTURE... --body BODY.toml")
    new, asked = write_body, [api.parse_expectation(text) for text in expect]
    clicks = dict(map(api.parse_click, sample))
    if (new and (len(pictures) > 1 or not (clicks or asked))) or (clicks and not new):
        raise ConfigError(
            "--write-body takes one picture and --sample or --expect; --sample needs it"
        )
    drawn = api.drawings(pictures, out, overwrite)
    with api.output(new, overwrite) as file, console.progress("looking", "pictures") as report:
        known = api.read_body(body)
        seen = api.detect(pictures, registry, method.chosen(), known, lens, asked, report)
        api.draw(seen, drawn)
        if new is not None:
            outlined = [ball for ball, _ in asked if ball not in clicks]
            api.write_sampled_body(file, known, seen[0], clicks, outlined)
    if json:
        console.print_json({"pictures": [_values(one) for one in seen]})
        return
    _print(seen)
    if out is not None:
        console.print_text(f"drawn in {out}")
    if new is not None:
        console.print_text(f"body with the colours of {seen[0].picture.name}: {new}")


_ASSUMED = {
    api.FocalFrom.BALLS: "found from the outlines of the balls",
    api.FocalFrom.TAGS: "from the picture's Exif tags",
    api.FocalFrom.USUAL: "an ordinary webcam's, assumed: --focal-px or --calibration say it",
}
"""The note on a focal length that was not given."""


def _values(one: SeenPicture) -> dict[str, object]:
    keys = ("ball", "center_px", "radius_px", "covariance_px", "score", "color_match")
    found = [{key: getattr(d, key) for key in keys} for d in one.detections]
    lens = {"focal_px": one.focal_px, "focal_from": one.focal_from}
    return {"picture": one.picture, **lens, "turned": one.orientation.turns, "detections": found}


def _print(seen: Sequence[SeenPicture]) -> None:
    rows = [
        (one.picture.name, d.ball, *d.center_px, d.radius_px, d.variance_px2**0.5, d.score)
        for one in seen
        for d in one.detections
    ]
    if rows:
        heads = ("picture", "ball", "u_px", "v_px", "radius_px", "sd_px", "score")
        console.print_table(heads, rows)
    for one in seen:
        if not one.detections:
            console.print_text(
                f"{one.picture}: no ball is seen: is its colour the one in the body file, and its "
                "radius 7 px or more?"
            )
        if one.focal_from in _ASSUMED:
            console.print_text(
                f"{one.picture}: focal length {one.focal_px:.0f} px, {_ASSUMED[one.focal_from]}"
            )
        if one.orientation.turns:
            console.print_text(
                f"{one.picture}: turned as its tag asks; pixels are counted as a viewer shows it"
            )

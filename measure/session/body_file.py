"""The body file: balls with their places, radii and colours, read and written."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field, FiniteFloat, ValidationInfo, field_validator, model_validator

from measure.arrays import Bytes, Floats
from measure.errors import DegenerateGeometryError, SessionError
from measure.model import Ball, BallColor, Body, ColorRange
from measure.model.body import HUE_PERIOD, NAMED_RANGES, USUAL_RADIUS_TOLERANCE_MM
from measure.reading import FileModel
from measure.session.files import Length, Name, Position, SafeName, dump_toml, load_toml
from measure.session.pictures import read_picture

Level = Annotated[int, Field(ge=0, le=255)]
Triple = tuple[Level, Level, Level]

_LEAST_RADIUS_MM = 0.5  # Smaller balls show no outline to a webcam: sizes are then rather metres
_MOST_TOLERANCE_MM = 10.0
Tolerance = Annotated[FiniteFloat, Field(ge=0, le=_MOST_TOLERANCE_MM)]
_TOUCHING = 0.9
"""Share of the radii's sum by which balls that touch are apart at least, carelessly measured."""


class RangeModel(FileModel):
    """Bounds in OpenCV's 8-bit scales: `low` and `high`, inclusive."""

    low: Triple
    high: Triple

    def refuse_empty(self, space: str) -> None:
        """Refuse bounds between which no colour is."""
        low, high = list(self.low), list(self.high)
        if space == "hsv" and low[0] >= HUE_PERIOD:
            raise ValueError(f"{space}: hues run from 0 to {HUE_PERIOD - 1}, low is {low}")
        # A hue alone may run from high to low: across red.
        first = 1 if space == "hsv" else 0
        if any(a > b for a, b in zip(low[first:], high[first:], strict=True)):
            raise ValueError(f"{space}: no colour lies between low {low} and high {high}")

    def range(self, space: Literal["hsv", "lab"]) -> ColorRange:
        """As a range of the model; in HSV a hue from high to low runs across red."""
        return ColorRange(space, self.low, self.high)


class CropModel(FileModel):
    """A patch of a picture that shows nothing but the ball."""

    image: Name
    crop_xywh: tuple[int, int, Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]


class ColorModel(FileModel):
    """A colour that is not a common name: exactly one of these."""

    samples_bgr: list[Triple] | None = None
    samples: CropModel | None = None
    hsv: RangeModel | list[RangeModel] | None = None
    lab: RangeModel | list[RangeModel] | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> ColorModel:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"give one of samples_bgr, samples, hsv or lab, not {found}")
        if self.samples_bgr is not None and len(self.samples_bgr) < 3:
            raise ValueError(f"samples_bgr needs at least 3 samples, got {len(self.samples_bgr)}")
        return self

    @model_validator(mode="after")
    def _holds_a_color(self) -> ColorModel:
        if self.hsv == [] or self.lab == []:
            raise ValueError("holds no range: give {hsv = {low = [...], high = [...]}}")
        for space in ("hsv", "lab"):
            for box in self._boxes(space):
                box.refuse_empty(space)
        return self

    def _boxes(self, space: str) -> list[RangeModel]:
        given: RangeModel | list[RangeModel] | None = getattr(self, space)
        return given if isinstance(given, list) else [given] if given is not None else []

    def color(self, folder: Path) -> BallColor:
        """As the model's colour; pictures are looked for relative to `folder`."""
        if self.samples_bgr is not None:
            return BallColor.from_samples(self.samples_bgr)
        if self.samples is not None:
            return BallColor.from_samples(_crop_samples(self.samples, folder))
        space: Literal["hsv", "lab"] = "hsv" if self.hsv is not None else "lab"
        return BallColor("range", tuple(box.range(space) for box in self._boxes(space)))


class BallModel(FileModel):
    """One `[[balls]]` table."""

    name: SafeName
    color: str | ColorModel
    center_mm: Position
    radius_mm: Length

    @field_validator("color", mode="before")
    @classmethod
    def _known_color(cls, value: Any, info: ValidationInfo) -> Any:  # noqa: ARG003 -- pydantic's
        if isinstance(value, str) and value.lower() not in NAMED_RANGES:
            known = ", ".join(NAMED_RANGES)
            raise ValueError(
                f"'{value}' is not a colour known by name ({known}); "
                "or give {samples_bgr = [[b, g, r], ...]} or {hsv = {low = [...], high = [...]}}"
            )
        return value if not isinstance(value, str) else value.lower()


class BodyModel(FileModel):
    """A body file, or the `[body]` table of a session."""

    name: SafeName = "body"
    tolerance_mm: Tolerance = 0.0
    radius_tolerance_mm: Tolerance = USUAL_RADIUS_TOLERANCE_MM
    balls: list[BallModel]

    @model_validator(mode="after")
    def _names_differ(self) -> BodyModel:
        names = [ball.name for ball in self.balls]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two balls are called '{name}'; each needs a name of its own")
        return self

    @model_validator(mode="after")
    def _sizes_can_be(self) -> BodyModel:
        largest = max((ball.radius_mm for ball in self.balls), default=_LEAST_RADIUS_MM)
        if largest < _LEAST_RADIUS_MM:
            raise ValueError(
                f"the largest radius is {largest:.3g} mm: this looks like metres: write mm"
            )
        for a, b in combinations(self.balls, 2):
            apart, room = math.dist(a.center_mm, b.center_mm), a.radius_mm + b.radius_mm
            if apart < _TOUCHING * room:
                raise ValueError(
                    f"balls '{a.name}' and '{b.name}' are {apart:.1f} mm apart and overlap, as "
                    f"their radii add up to {room:.1f} mm; are these diameters, or is a centre "
                    "wrong?"
                )
        return self

    def body(self, source: Path) -> Body:
        """As the model's body; SessionError if it has no pose, or samples cannot be used."""
        try:
            balls = tuple(_ball(ball, source.parent) for ball in self.balls)
            return Body(self.name, balls, self.tolerance_mm, self.radius_tolerance_mm)
        except DegenerateGeometryError as problem:
            raise SessionError(f"{source}: {problem}") from None


def read_body(path: Path | str) -> Body:
    """Read a body file; SessionError with file, line and key, or for collinear balls."""
    return load_toml(path, BodyModel).body(Path(path))


def read_bodies(path: Path | str) -> tuple[Body, ...]:
    """Read several bodies from one file, as `write_bodies` writes it; raises as `read_body`."""
    return tuple(one.body(Path(path)) for one in load_toml(path, _BodiesModel).bodies)


class _BodiesModel(FileModel):
    bodies: list[BodyModel]


def write_bodies(path: Path | str, bodies: Sequence[Body]) -> None:
    """Write several bodies into one file."""
    values = {"bodies": [_body_values(body, {}) for body in bodies]}
    Path(path).write_text(dump_toml(values), encoding="utf-8")


def write_body(
    path: Path | str, body: Body, samples_bgr: Mapping[str, Bytes] | None = None, comment: str = ""
) -> None:
    """Write a body file; learnt colours become ranges, or `samples_bgr` (n, 3), by ball.

    A `comment` is its first line.
    """
    text = dump_toml(_body_values(body, samples_bgr or {}))
    Path(path).write_text(f"# {comment}\n{text}" if comment else text, encoding="utf-8")


def _body_values(body: Body, samples_bgr: Mapping[str, Bytes]) -> dict[str, Any]:
    sampled = {ball: {"samples_bgr": some.tolist()} for ball, some in samples_bgr.items()}
    balls = [
        {
            "name": ball.name,
            "color": sampled.get(ball.name) or _color_values(ball.color),
            "center_mm": ball.center_mm,
            "radius_mm": float(ball.radius_mm),
        }
        for ball in body.balls
    ]
    return {
        "name": body.name,
        "tolerance_mm": body.tolerance_mm or None,
        "radius_tolerance_mm": body.radius_tolerance_mm,
        "balls": balls,
    }


def _ball(given: BallModel, folder: Path) -> Ball:
    if isinstance(given.color, str):
        color = BallColor.named(given.color)
    else:
        color = given.color.color(folder)
    return Ball(given.name, color, np.array(given.center_mm), given.radius_mm)


def _crop_samples(samples: CropModel, folder: Path) -> Floats:
    picture = read_picture(folder / samples.image)
    x, y, width, height = samples.crop_xywh
    crop = picture[max(y, 0) : y + height, max(x, 0) : x + width]
    if crop.shape[:2] != (height, width):
        raise SessionError(
            f"{folder / samples.image}: the crop at ({x}, {y}) of {width}x{height} px "
            f"leaves the picture of {picture.shape[1]}x{picture.shape[0]} px"
        )
    small = cv2.resize(crop, (min(width, 64), min(height, 64)), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float64).reshape(-1, 3)


def _color_values(color: BallColor) -> Any:
    if NAMED_RANGES.get(color.name) == color.ranges:
        return color.name
    spaces = {r.space for r in color.ranges}
    if len(spaces) != 1:
        raise SessionError(f"colour '{color.name}' mixes HSV and Lab ranges: a file holds only one")
    boxes = [{"low": list(r.low), "high": list(r.high)} for r in color.ranges]
    return {spaces.pop(): boxes[0] if len(boxes) == 1 else boxes}

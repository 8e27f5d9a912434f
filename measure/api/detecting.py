"""What a detector sees in single pictures, with no recording; and the colours of balls in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from measure import model
from measure.api.lenses import FocalFrom, Lens, LensOf, camera_by_balls
from measure.api.outputs import check_apart, check_file, output
from measure.api.profiles import build_detectors
from measure.arrays import Bools, Bytes, Floats
from measure.errors import ConfigError
from measure.estimation.lateral_color import with_lateral_color
from measure.host import Detector, Registry
from measure.measuring import Profile, plugin_calls
from measure.processes import Progress, quiet
from measure.session import (
    Orientation,
    decode_picture,
    picture_bytes,
    picture_tags,
    read_picture,
    write_body,
)

_SIZE_FACTOR = 1.25  # How much larger or smaller than expected a ball may be
_PLACE_STEPS = 4
_REACH_RADII = 0.5  # How far from where it is expected a ball may be, in its radii


@dataclass(frozen=True, eq=False)
class SeenPicture:
    """The balls seen in one picture; coordinates are those of the picture as a viewer shows it."""

    picture: Path
    detections: tuple[model.Detection, ...]  # the best first
    outlines_px: tuple[Floats, ...]  # of each detection, (n, 2) around it
    focal_px: float  # focal length of the camera
    focal_from: FocalFrom
    orientation: Orientation  # how a viewer turns the stored picture

    def shown(self) -> Bytes:
        """The picture (h, w, 3), B G R, as a viewer shows it."""
        return self.orientation.shown(read_picture(self.picture))


def parse_expectation(text: str) -> tuple[str, tuple[float, float, float]]:
    """Read BALL=U,V,R: a ball's name, its centre and radius in px; ConfigError if it is not."""
    ball, (u, v, radius) = numbers_of(
        text, "--expect", "BALL=U,V,R, such as red=640,360,45 (in px)", 3
    )
    if radius <= 0:
        raise ConfigError(f"--expect {text}: the radius R is a number of px above 0")
    return ball, (u, v, radius)


def numbers_of(text: str, option: str, form: str, count: int) -> tuple[str, list[float]]:
    """Read a ball's name and so many numbers from an option's value of a `form`."""
    ball, _, given = text.rpartition("=")
    try:
        numbers = [float(number) for number in given.split(",")]
    except ValueError:
        numbers = []
    if not ball or len(numbers) != count or not np.isfinite(numbers).all():
        raise ConfigError(f"{option} {text}: expected {form}")
    return ball, numbers


def detect(
    pictures: Sequence[Path],
    registry: Registry,
    profile: Profile,
    body: model.Body,
    lens: Lens | model.Camera | None = None,
    expected: Iterable[tuple[str, tuple[float, float, float]]] = (),
    progress: Progress = quiet,
) -> tuple[SeenPicture, ...]:
    """Find a body's balls in single pictures.

    Args:
        lens: what says which camera it is; or the camera itself, and then coordinates are those of
            the stored pictures, whatever their orientation tags ask for.
        expected: balls, where their centres are and their radii in px; without any the whole
            picture is searched for all balls.
    """
    asked = dict(expected)
    if unknown := [ball for ball in asked if ball not in body.names]:
        raise ConfigError(
            f"--expect {unknown[0]}: the body has no such ball, but {', '.join(body.names)}"
        )
    cameras, stored = LensOf(lens or Lens()), isinstance(lens, model.Camera)
    build = partial(build_detectors, profile, registry, body)
    seen = []
    for index, path in enumerate(pictures):
        data = picture_bytes(path)
        pixels, tags = decode_picture(data, str(path)), picture_tags(data)
        height, width = pixels.shape[:2]
        turn = Orientation((width, height), 1 if stored else tags.orientation)
        camera = cameras.of(width, height, path)
        image = model.Image(camera.name, index, 0.0, partial(np.asarray, pixels))
        (camera,) = with_lateral_color([camera], [model.FrameSet(index, 0.0, {camera.name: image})])
        seen_by = partial(look, image, body, build, _stored(asked, turn))
        focal_from = cameras.focal_from
        if focal_from is FocalFrom.USUAL:
            camera, focal_from = camera_by_balls(camera, tags.focal_35mm, seen_by)
        found = sorted(seen_by(camera), key=lambda d: -d.score)
        shown = tuple(_shown(d, turn) for d in found)
        outlines = tuple(turn.points_shown(_outline(d, body, camera)) for d in found)
        focal_px = camera.intrinsics.focal_px
        seen.append(SeenPicture(path, shown, outlines, focal_px, focal_from, turn))
        progress(index + 1, len(pictures))
    return tuple(seen)


Places = Mapping[str, tuple[float, float, float]]
"""Where balls are expected: centre u, v and radius in px."""


def look(
    image: model.Image,
    body: model.Body,
    build: Callable[[Sequence[model.Camera]], Mapping[str, Detector]],
    asked: Places,
    camera: model.Camera,
) -> list[model.Detection]:
    """What is seen of a body's balls, or of those asked for, in a picture of a camera."""
    where = [_expectation(ball, at, body, camera) for ball, at in asked.items()]
    (detector,) = build([camera]).values()
    found = plugin_calls.detections(detector, image, where, body)
    return [d for d in found if not asked or d.ball in asked]


def _stored(asked: Places, turn: Orientation) -> Places:
    """Places in the stored picture of those in the picture as it is shown."""
    return {
        ball: (*turn.points_stored(np.array([[u, v]]))[0].tolist(), radius)
        for ball, (u, v, radius) in asked.items()
    }


def _shown(stored: model.Detection, turn: Orientation) -> model.Detection:
    """A detection in the picture as it is shown."""
    outline = stored.outline_px
    return replace(
        stored,
        center_px=turn.points_shown(stored.center_px[None])[0],
        covariance_px=turn.matrix @ stored.covariance_px @ turn.matrix.T,
        outline_px=None if outline is None else turn.points_shown(outline),
    )


def _outline(detection: model.Detection, body: model.Body, camera: model.Camera) -> Floats:
    """The outline (n, 2) that a detection means; a circle where the lens has none."""
    center_px, radius_px = detection.center_px, detection.radius_px
    radius_mm = body.radii[body.index(detection.ball)]
    center = _place(center_px, radius_px, radius_mm, camera)
    if center is not None and np.linalg.norm(center) > radius_mm:
        outline = camera.outline(center, radius_mm)
        if np.isfinite(outline).all():
            return outline
    angles = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    return center_px + radius_px * np.column_stack([np.cos(angles), np.sin(angles)])


def _expectation(
    ball: str, at: tuple[float, float, float], body: model.Body, camera: model.Camera
) -> model.Expectation:
    u, v, radius_px = at
    center = np.array([u, v])
    return model.Expectation(
        ball,
        center,
        (radius_px / _SIZE_FACTOR, radius_px * _SIZE_FACTOR),
        2 * radius_px,
        _REACH_RADII * radius_px,
        center_camera=_place(center, radius_px, body.radii[body.index(ball)], camera),
    )


def _place(
    center_px: Floats, radius_px: float, radius_mm: float, camera: model.Camera
) -> Floats | None:
    """The centre (3,) in mm of a sphere of this outline, by its mean radius; None off the lens."""
    bearing = camera.intrinsics.unproject(center_px[None])[0]
    if not np.isfinite(bearing).all():
        return None
    distance_mm = radius_mm * camera.intrinsics.focal_px / radius_px
    for _ in range(_PLACE_STEPS):
        outline = camera.outline(distance_mm * bearing, radius_mm)
        seen_px = np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean()
        if not np.isfinite(seen_px):
            return None
        distance_mm *= float(seen_px) / radius_px
    return np.asarray(distance_mm * bearing)


def drawings(pictures: Sequence[Path], out: Path | None, overwrite: bool = False) -> list[Path]:
    """The files in a folder to draw into, all free to be written; none without a folder."""
    drawn = [] if out is None else [out / f"{picture.stem}.png" for picture in pictures]
    check_apart(*drawn)
    for one in drawn:
        check_file(one, overwrite, pictures)
    return drawn


def draw(seen: Iterable[SeenPicture], drawn: Iterable[Path]) -> None:
    """Draw the outlines into copies of the pictures."""
    from measure.viewing.drawings import write_outlines

    for one, file in zip(seen, drawn, strict=False):
        with output(file, overwrite=True) as fresh:
            write_outlines(one.shown(), one.detections, one.outlines_px, fresh)


PATCH_PX, _INSIDE = 3, 0.8
"""Half side of the patch about a click; share of an outline's radius inside which is sampled."""
_FEWEST, _MOST = 30, 24
"""Fewest pixels of a ball that are sampled, and how many samples are written."""
_ROUND_SHARE = 0.65
"""Share of the smallest circle about it that a ball-like patch fills: a square fills 0.64, a ball
with highlight and shade 0.68 to 0.95."""
_LEAST_CHROMA = 20
"""Median difference between the channels (of 255) below which noise makes the hue: balls have 35
and more, black cloth has 5."""


def parse_click(text: str) -> tuple[str, tuple[float, float]]:
    """Read BALL=U,V: a ball's name and a pixel on it; ConfigError for anything else."""
    ball, (u, v) = numbers_of(text, "--sample", "BALL=U,V, such as red=640,360 (in px)", 2)
    return ball, (u, v)


def write_sampled_body(
    to: Path,
    body: model.Body,
    seen: SeenPicture,
    clicks: Mapping[str, tuple[float, float]],
    outlined: Iterable[str],
) -> None:
    """Write a body with the colours that balls have in a picture, as `samples_bgr`.

    Sampled is what is connected to clicked pixels and of their colour, and the inside of outlines.
    ConfigError: a ball that the body has not, or that is not seen.
    """
    if unknown := [ball for ball in clicks if ball not in body.names]:
        names = ", ".join(body.names)
        raise ConfigError(f"--sample {unknown[0]}: the body has no such ball, but {names}")
    pixels, best = seen.shown(), {d.ball: d for d in reversed(seen.detections)}
    found = {
        ball: sampled_color(pixels, body.balls[body.index(ball)], at) for ball, at in clicks.items()
    }
    for ball in outlined:
        if ball not in best:
            raise ConfigError(f"{seen.picture}: {ball} is not seen: give --sample {ball}=U,V")
        inside, (u, v) = np.zeros(pixels.shape[:2], np.uint8), np.rint(best[ball].center_px)
        cv2.circle(inside, (int(u), int(v)), int(_INSIDE * best[ball].radius_px), 255, -1)
        found[ball] = _representative(pixels[inside > 0])
    write_body(to, body, found)


Samples = Bytes
"""Colours that stand for a ball, BGR (n, 3)."""


def sampled_color(pixels: Bytes, ball: model.Ball, at: tuple[float, float]) -> Samples:
    """Samples of a click's colour: of the picture's pixels (h, w, 3) that are connected to it.

    Raises:
        ConfigError: nothing there is as round as a ball; or it has no colour, where the ball has.
    """
    u, v = round(at[0]), round(at[1])
    where = f"--sample {ball.name}={u},{v}"
    height, width = pixels.shape[:2]
    if not (0 <= u < width and 0 <= v < height):
        raise ConfigError(f"{where}: lies outside the picture of {width}x{height}")
    rows = slice(max(v - PATCH_PX, 0), v + PATCH_PX + 1)
    patch = pixels[rows, max(u - PATCH_PX, 0) : u + PATCH_PX + 1].reshape(-1, 3)
    mask = model.BallColor.from_samples(patch, hue_margin=8, level_margin=50).mask(pixels)
    _, labels = cv2.connectedComponents(mask)
    inside = (labels == labels[v, u]) & (mask > 0)
    found = np.asarray(pixels[inside])
    missing = [] if _is_round(inside) else ["no ball-like patch"]
    chroma = np.median(np.ptp(found.astype(int), axis=1)) if len(found) else 0.0
    if chroma < _LEAST_CHROMA and not ball.color.is_colorless:
        missing.append("no colour")
    if missing:
        raise ConfigError(f"{where}: {', '.join(missing)} here: click a ball that is seen whole")
    return _representative(found)


def clicked_color(pixels: Bytes, at: tuple[float, float], name: str = "ball") -> Samples:
    """Samples of the colour of whatever ball lies at a pixel (u, v) of a picture (h, w, 3).

    Raises:
        ConfigError: nothing there is as round as a ball; or it is grey or black.
    """
    row, column = (
        round(min(max(x, 0), size - 1)) for x, size in zip(at[::-1], pixels.shape[:2], strict=True)
    )
    white = model.BallColor.named("white")
    is_white = bool(white.matches(pixels[row, column][None])[0])
    color = white if is_white else model.BallColor.named("red")
    return sampled_color(pixels, model.Ball(name, color, np.zeros(3), 1.0), at)


def learnt_colors(texts: Iterable[str]) -> dict[str, model.BallColor]:
    """Colours of balls by name, from texts NAME=PICTURE:U,V: a pixel on the ball in a picture.

    Raises:
        ConfigError: a text is of another form, or no ball lies there.
        MeasureError: a picture cannot be read.
    """
    samples: dict[str, list[Samples]] = {}
    for text in texts:
        name, _, rest = text.partition("=")
        picture, _, place = rest.rpartition(":")
        form = "NAME=PICTURE:U,V, such as white=SESSION/cam0/000000.jpg:588,358 (in px)"
        _, (u, v) = numbers_of(f"{name}={place}", "--sample", form, 2)
        if not picture:
            raise ConfigError(f"--sample {text}: expected {form}")
        samples.setdefault(name, []).append(
            clicked_color(read_picture(Path(picture)), (u, v), name)
        )
    return {
        name: model.BallColor.from_samples(np.concatenate(some)) for name, some in samples.items()
    }


def _is_round(inside: Bools) -> bool:
    """Whether a connected patch, its holes filled, is as round as a ball and large enough."""
    if np.count_nonzero(inside) < _FEWEST:
        return False
    outlines, _ = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    (outline,) = outlines
    _, radius_px = cv2.minEnclosingCircle(outline)
    return bool(cv2.contourArea(outline) >= _ROUND_SHARE * np.pi * radius_px**2)


def _representative(some: Bytes) -> Bytes:
    """Samples from the darkest to the brightest, evenly; highlights and holes are at the ends."""
    order = np.argsort(some.sum(axis=1), kind="stable")
    return some[order[np.rint(np.linspace(0.05, 0.95, _MOST) * (len(some) - 1)).astype(int)]]

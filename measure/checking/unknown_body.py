"""The layout of a body with only a ball's size known, from balls seen in a recording.

Balls are searched by the common colours and located where the rays of several cameras intersect.
What keeps its distances while it moves is a body; its shape follows from them (classical
multidimensional scaling, Torgerson 1952), good enough to measure it with and to adjust it then.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.distance import squareform

from measure.arrays import Floats
from measure.checking.body import outline_sizes
from measure.errors import DegenerateGeometryError, SessionError
from measure.estimation.body_layout import looks_mirrored
from measure.geometry.covariance import MAD_TO_SD
from measure.limits import SIGNIFICANT_SIGMAS
from measure.measuring.pose_hypotheses import by_ball, intersect_rays
from measure.model import Ball, BallColor, Body, Camera, Detection

PALETTES = (("red", "yellow", "green", "blue", "white"), ("orange", "cyan", "purple", "pink"))
"""Colours searched for, in groups of few that overlap little."""
_SEARCHED = (
    f"; searched for {', '.join(color for group in PALETTES for color in group)}: --like gives the "
    "colours of other balls"
)
_RANGE_RATIO = 2.5
_FEWEST_FRAMES, _FEWEST_SEEN = 6, 3  # Frame sets in which a ball of the body, and a thing, is seen
_LEAST_SHARE = 0.3  # Of the frame sets, in which a ball must be located
_ALIKE = 0.2  # Relative difference of outlines up to which they are of balls of one size
_RIGID_RADII = 0.1  # Scatter of a distance, in radii, up to which it counts as constant
_LEAST_SIZE_SD = 0.015
"""Relative standard deviation of all sizes by their outlines at best; how far off is wrong."""
_TWINS = 0.5
"""Share of a ball's frame sets with a second one of its colour from which there are two."""


@dataclass(frozen=True, eq=False)
class SeenBall:
    """A ball of one frame set."""

    center: Floats  # (3,) in the world, mm
    radius_mm: float  # by the outlines
    radius_sd_mm: float  # of a single outline
    match: float  # sum over the cameras of how well its pixels match the colour
    alone: bool  # whether no other ball of this colour is seen


def search_bodies(
    radius_mm: float, learnt: Mapping[str, BallColor] | None = None, without: Collection[str] = ()
) -> list[Body]:
    """Bodies to search pictures for where none is known: of colours that overlap little.

    SessionError: fewer than three colours are left.

    Args:
        learnt: colours that are searched beside the common ones, by the ball's name.
        without: common colours that are not searched.
    """
    learnt = learnt or {}
    named = {c: BallColor.named(c) for group in PALETTES for c in group}
    groups = [[c for c in group if c not in {*without, *learnt}] for group in PALETTES]
    groups += [some.tolist() for some in np.array_split([*learnt], -(-len(learnt) // 6) or 1)]
    groups = sorted(filter(None, groups), key=len, reverse=True)
    while len(groups) > 1 and len(groups[-1]) < 3:
        groups[-2:] = [groups[-2] + groups[-1]]
    if not groups or len(groups[0]) < 3:
        raise SessionError("a body needs 3 balls: fewer colours than that are searched for")
    return [probe(group, radius_mm, {**named, **learnt}) for group in groups]


def probe(
    colors: Sequence[str], radius_mm: float, known: Mapping[str, BallColor] | None = None
) -> Body:
    """Balls of common colours, or of those known by name, laid out anyhow, to search for."""
    angle = 2 * np.pi * np.arange(len(colors)) / len(colors)
    ring = 2 * radius_mm * len(colors) / np.pi
    places = ring * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    known = known or {c: BallColor.named(c) for c in colors}
    named = zip(colors, places, strict=True)
    return Body("body", tuple(Ball(c, known[c], at, radius_mm) for c, at in named))


def locate(
    detections: Mapping[str, Sequence[Detection]],
    body: Body,
    cameras: Sequence[Camera],
    least: int = 3,
) -> dict[str, SeenBall]:
    """The balls of one frame set by name, by candidates of whole pictures, by camera.

    At least so many cameras must see a ball, where there are as many.
    """
    out, least = {}, min(least, len(cameras))
    for ball, candidates in zip(body.balls, by_ball(detections, body.balls, cameras), strict=True):
        found = intersect_rays(candidates, SIGNIFICANT_SIGMAS, _RANGE_RATIO, max_points=8)
        points = found.points[found.support >= least]
        if not len(points):
            continue
        sizes = outline_sizes(candidates.detections, points[0], cameras)
        if len(sizes) < 2:
            continue
        radius, sd = np.median(sizes, axis=0).tolist()
        away = np.linalg.norm(points - points[0], axis=1)
        shown = {c.name: c.project(points[:1])[0] for c in cameras}
        match = sum(
            d.color_match
            for d in candidates.detections
            if np.isfinite(d.color_match)
            and np.linalg.norm(shown[d.camera] - d.center_px) < d.radius_px / 2
        )
        out[ball.name] = SeenBall(points[0], radius, sd, match, bool(np.all(away < radius)))
    return out


def find_layout(frames: Sequence[Mapping[str, SeenBall]], body: Body, *, pick: bool) -> Body:
    """The balls that move together, with their layout about their centroid.

    SessionError: fewer than three balls that keep their distances, two of one colour, or balls of
    another size than stated.

    Args:
        frames: balls by name, frame set by frame set.
        body: their colours and radii; its layout is not used.
        pick: whether names are overlapping colours and the best is meant; else all balls.
    """
    names = _distinct(frames, body) if pick else list(body.names)
    often = max(_FEWEST_FRAMES, _LEAST_SHARE * len(frames))
    seen = [n for n in names if sum(n in f for f in frames) >= often]
    if len(seen) < 3:
        raise SessionError(
            f"{_listed(seen)} seen by several cameras in {often:.0f} or more of {len(frames)} "
            f"frame sets, but a body needs 3 balls{_paint(frames, seen)}{_SEARCHED if pick else ''}"
        )
    alone = {n: np.mean([f[n].alone for f in frames if n in f]) for n in seen}
    if twice := [n for n in seen if pick and 1 - alone[n] > _TWINS]:
        raise SessionError(
            f"two {twice[0]} balls are seen: take one out of view, or give --like, a body file "
            "with the approximate layout, that tells them apart"
        )
    group = _rigid(frames, _of_one_size(frames, seen) if pick else seen, body)
    if len(group) < 3:
        raise SessionError(
            f"{_listed(seen)} seen, but no three of them keep their distances: is the body rigid, "
            "and the calibration this recording's? `measure check` tells"
        )
    _check_size(frames, group, body)
    return _laid_out(frames, group, body)


def left_out(
    frames: Sequence[Mapping[str, SeenBall]], body: Body, kept: Sequence[str]
) -> tuple[str, ...]:
    """Colours that are seen but are no ball of the layout, each with the reason, in words."""
    out = []
    usual = float(np.median([f[n].radius_mm for f in frames for n in kept if n in f]))
    for name in (name for name in body.names if name not in kept):
        own = [f for f in frames if name in f]
        near = [np.linalg.norm(f[name].center - f[n].center) for f in own for n in kept if n in f]
        if len(own) < _FEWEST_SEEN or min(near, default=np.inf) < body.radii[0]:
            continue  # chance, or what another colour sees better
        radius = float(np.median([f[name].radius_mm for f in own]))
        apart = max(_apart(frames, name, n)[1] for n in kept)
        why = f"in {len(own)} of {len(frames)} frame sets only"
        if abs(radius / usual - 1) >= _ALIKE:
            why = f"its radius looks like {radius:.1f} mm, the others' like {usual:.1f} mm"
        elif np.isfinite(apart) and apart >= _RIGID_RADII * body.radii.max():
            why = f"its distances from the others change by {apart:.1f} mm"
        out.append(f"{name} is seen, but left out: {why}")
    return tuple(out)


def _paint(frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str]) -> str:
    """What to do about two balls of one colour, the likeliest reason for one too few."""
    twice = [n for n in names if np.mean([not f[n].alone for f in frames if n in f]) > _TWINS]
    return f"; two balls look {twice[0]}: paint one of them in another colour" if twice else ""


def _distinct(frames: Sequence[Mapping[str, SeenBall]], body: Body) -> list[str]:
    """Colours without those that only see what another one sees better."""
    total = {n: sum(f[n].match for f in frames if n in f) for n in body.names}
    kept: list[str] = []
    for name in sorted(body.names, key=lambda n: -total[n]):
        apart = [
            np.median([np.linalg.norm(f[name].center - f[k].center) for f in both])
            for k in kept
            if (both := [f for f in frames if name in f and k in f])
        ]
        if total[name] and all(d > body.radii[0] for d in apart):
            kept.append(name)
    return [n for n in body.names if n in kept]


def _of_one_size(frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str]) -> list[str]:
    """Those whose outlines are as large as most: a body has balls of one size."""
    sizes = _sizes(frames, names)
    return np.array(names)[np.abs(sizes / np.median(sizes) - 1) < _ALIKE].tolist()


def _apart(frames: Sequence[Mapping[str, SeenBall]], a: str, b: str) -> tuple[float, float]:
    """Median distance of two balls, and its robust scatter, mm; the scatter inf if unknown."""
    both = np.array(
        [np.linalg.norm(f[a].center - f[b].center) for f in frames if a in f and b in f]
    )
    if len(both) < _FEWEST_FRAMES:
        return float("nan"), float("inf")
    median = float(np.median(both))
    return median, MAD_TO_SD * float(np.median(np.abs(both - median)))


def _rigid(
    frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str], body: Body
) -> tuple[str, ...]:
    """The largest group of balls with constant distances; the steadiest of several."""
    scatter = {pair: _apart(frames, *pair)[1] for pair in combinations(names, 2)}
    for size in range(len(names), 2, -1):
        groups = [
            (max(scatter[pair] for pair in combinations(group, 2)), group)
            for group in combinations(names, size)
        ]
        worst, group = min(groups)
        if worst < _RIGID_RADII * body.radii.max():
            return group
    return ()


def _check_size(frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str], body: Body) -> None:
    """Refuse a size that the outlines contradict, at distances by the calibration's scale."""
    seen = [f[name] for f in frames for name in names if name in f]
    sd_mm = np.median([ball.radius_sd_mm for ball in seen]) / np.sqrt(len(seen))
    # By a common colour a ball may look too large or too small in every picture.
    uneven_mm = np.std(_sizes(frames, names), ddof=1) / np.sqrt(len(names))
    shares = np.array([sd_mm, uneven_mm]) / body.radii[0]
    least = SIGNIFICANT_SIGMAS * float(np.linalg.norm([*shares, _LEAST_SIZE_SD]))
    if problem := wrong_size(frames, body, least):
        raise SessionError(f"--radius-mm {body.radii[0]:g}: {problem}")


def _sizes(frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str]) -> Floats:
    """Each ball's radius in most frame sets, mm."""
    return np.array([np.median([f[n].radius_mm for f in frames if n in f]) for n in names])


def wrong_size(
    frames: Sequence[Mapping[str, SeenBall]], body: Body, least: float = _LEAST_SIZE_SD
) -> str:
    """What balls that look larger or smaller than stated, by that share at least, may come from.

    Empty if they do not.
    """
    seen = [f[name].radius_mm for f in frames for name in body.names if name in f]
    stated, radius_mm = float(body.radii[0]), float(np.median(seen))
    if abs(radius_mm / stated - 1) <= least:
        return ""
    return (
        f"by the calibration's scale the balls have a radius of {radius_mm:.2f} mm, not "
        f"{stated:g}. Was the printed board's square measured? Squares {stated / radius_mm:.3f} "
        "times as long as their file says would explain it; so would another radius (half of what "
        "callipers show)"
    )


def _laid_out(frames: Sequence[Mapping[str, SeenBall]], names: Sequence[str], body: Body) -> Body:
    """The body of these balls: centres from all their distances, about the centroid."""
    squares = squareform([_apart(frames, *pair)[0] ** 2 for pair in combinations(names, 2)])
    centring = np.eye(len(names)) - 1 / len(names)
    values, axes = np.linalg.eigh(-0.5 * centring @ squares @ centring)
    centers = centring @ axes[:, -3:] * np.sqrt(np.maximum(values[-3:], 0.0))
    whole = [np.stack([f[n].center for n in names]) for f in frames if set(names) <= set(f)]
    if whole and np.mean([looks_mirrored(centers, points) for points in whole]) > 0.5:
        centers = centers * [1.0, 1.0, -1.0]
    balls = tuple(body.balls[body.index(n)] for n in names)
    try:
        return Body(body.name, balls).with_centers(centers)
    except DegenerateGeometryError as problem:
        raise SessionError(str(problem)) from None


def _listed(names: Sequence[str]) -> str:
    count = f"{len(names)} ball{'' if len(names) == 1 else 's'}"
    return f"{count} ({', '.join(names)})" if names else "no ball is"

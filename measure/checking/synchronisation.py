"""Clock offsets of any size, found by what each camera sees the balls do; no pose is needed.

Rays from two cameras to one ball lie in one plane with the line between the cameras if they belong
to one instant (the epipolar constraint; Hartley & Zisserman 2004, section 9.1). How far they miss
it is computed for every offset of one clock. An offset is taken if those that fit nearly as well
form one stretch around it: then the motion is known to tell.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import median_filter

from measure.arrays import Floats
from measure.model import Body, Camera, Detection

_LEAST_COMMON_S, _RIVAL_COMMON_SHARE = 0.25, 0.35
"""What an offset must leave in common, and of what the best one does: less cannot speak for it."""
_NEARLY, _LEAST_CONTRAST = 0.25, 0.7
"""Of the way from the best fit to that of unrelated instants, what fits better is a rival; and the
least length of that way."""
_CAP, _MAX_COST = float(np.log1p(6.0**2)), float(np.log1p(3.0**2))
"""Largest cost, log(1 + misfit^2) in px, of one ray: half a ball is off by any amount; and in the
mean of an offset at which cameras agree."""
_GAP_STEPS, _MEDIAN_IMAGES, _MIN_IMAGES = 2.5, 5, 4


@dataclass(frozen=True, eq=False)
class BallTracks:
    """Where one camera saw the balls."""

    camera: Camera
    times_s: Floats  # (n,) of its images, increasing
    pixels: Floats  # (n, b, 2) centres; NaN where a ball was not seen

    @classmethod
    def of(cls, camera: Camera, body: Body, seen: Iterable[Sequence[Detection]]) -> BallTracks:
        """The likeliest detection of each ball in every image, without jumps to other things."""
        times, rows = list[float](), []
        for detections in seen:
            row = np.full((len(body.balls), 3), np.nan)
            for d in sorted(detections, key=lambda d: d.score):
                row[body.index(d.ball)] = *d.center_px, d.radius_px
            if detections:
                times.append(detections[0].time_s)
                rows.append(row)
        table = np.array(rows).reshape(-1, len(body.balls), 3)
        for ball in range(len(body.balls)):
            here = np.flatnonzero(np.isfinite(table[:, ball, 0]))
            middle = median_filter(table[here, ball], size=(_MEDIAN_IMAGES, 1), mode="nearest")
            off = np.linalg.norm(table[here, ball, :2] - middle[:, :2], axis=1)
            table[here[off > middle[:, 2]], ball] = np.nan
        return cls(camera, np.array(times), table[:, :, :2])

    def directions(self, times_s: Floats) -> Floats:
        """Unit rays (m, b, 3) in the world at other times (m,); NaN in gaps and beyond the ends."""
        out = np.full((len(times_s), self.pixels.shape[1], 3), np.nan)
        longest = _GAP_STEPS * float(np.median(np.diff(self.times_s)))
        for ball, path in enumerate(np.moveaxis(self.pixels, 1, 0)):
            here = np.isfinite(path[:, 0])
            knots = self.times_s[here]
            if len(knots) < _MIN_IMAGES:
                continue
            after = np.searchsorted(knots, times_s, side="right")
            inside = (after > 0) & (after < len(knots))
            inside[inside] = np.diff(knots)[after[inside] - 1] < longest
            pixels = CubicSpline(knots, path[here])(times_s[inside])
            out[inside, ball] = self.camera.rays(pixels).directions
        return out


def synchronise(tracks: Sequence[BallTracks], largest_s: float, step_s: float) -> dict[str, float]:
    """Find what to add to each camera's stamps; uncertain ones are left out.

    The two cameras that tell most are brought together first, then each time the one that tells
    most, against all before it. Only differences are observable, `largest_s` at most: the median of
    the offsets is 0.
    """
    usable = [track for track in tracks if len(track.times_s) >= _MIN_IMAGES]
    pairs = [(_search(b, {a: 0.0}, largest_s, step_s), a) for a, b in combinations(usable, 2)]
    found = [(best, first) for best, first in pairs if best is not None]
    joined = dict[BallTracks, float]()
    while found:
        best, first = max(found, key=lambda item: item[0].contrast)
        joined = joined or {first: 0.0}
        joined[best.track] = best.offset_s
        rest = [_search(t, joined, largest_s, step_s) for t in usable if t not in joined]
        found = [(one, first) for one in rest if one is not None]
    middle = sorted(joined.values())[(len(joined) - 1) // 2] if joined else 0.0
    return {track.camera.name: offset_s - middle for track, offset_s in joined.items()}


class _Found(NamedTuple):
    track: BallTracks
    offset_s: float
    contrast: float


def _search(
    track: BallTracks, others: Mapping[BallTracks, float], largest_s: float, step_s: float
) -> _Found | None:
    """The offset of a track against others that are in time, unless the motion cannot tell it."""
    reach = round(largest_s / step_s)
    costs, counts = np.zeros(2 * reach + 1), np.zeros(2 * reach + 1)
    start, own = _on_grid(track, 0.0, step_s)
    for other, offset_s in others.items():
        first, theirs = _on_grid(other, offset_s, step_s)
        for lag in range(2 * reach + 1):
            ahead = start + lag - reach - first
            mine, its = own[max(-ahead, 0) :], theirs[max(ahead, 0) :]
            n = min(len(mine), len(its))
            off = _misfit_px(track, mine[:n], other, its[:n])
            costs[lag] += np.minimum(np.log1p(off**2), _CAP).sum()
            counts[lag] += len(off)
    enough = counts >= _LEAST_COMMON_S / step_s * max(track.pixels.shape[1] - 1, 1)
    if not enough.any():
        return None
    cost = np.where(enough, costs / np.maximum(counts, 1.0), _CAP)
    unrelated = float(np.median(cost[enough]))
    best = int(np.argmax(np.where(enough, counts * (unrelated - cost), -np.inf)))
    contrast = unrelated - float(cost[best])
    rivals = cost < cost[best] + _NEARLY * contrast
    where = np.flatnonzero(rivals & (counts > _RIVAL_COMMON_SHARE * counts[best]))
    several = where[-1] - where[0] >= len(where)
    if several or contrast < _LEAST_CONTRAST or cost[best] > _MAX_COST:
        return None
    return _Found(track, float((best - reach) * step_s), contrast)


def _on_grid(track: BallTracks, offset_s: float, step_s: float) -> tuple[int, Floats]:
    """Rays at whole multiples of `step_s` on the corrected clock, and the first multiple."""
    first = int(np.ceil((track.times_s[0] + offset_s) / step_s))
    count = int((track.times_s[-1] + offset_s) / step_s) - first + 1
    steps = first + np.arange(count, dtype=np.float64)
    return first, track.directions(steps * step_s - offset_s)


def _misfit_px(one: BallTracks, ones: Floats, other: BallTracks, others: Floats) -> Floats:
    """Distances (k,) of rays from the epipolar constraint, in px of their noise, where known."""
    ones, others = ones.reshape(-1, 3), others.reshape(-1, 3)
    known = np.isfinite(ones[:, 0]) & np.isfinite(others[:, 0])
    ones, others = ones[known], others[known]
    between = other.camera.center - one.camera.center
    by_one, by_other = np.cross(others, between), np.cross(between, ones)
    noise = np.sqrt(
        np.sum(by_one**2, axis=1) / one.camera.intrinsics.focal_px**2
        + np.sum(by_other**2, axis=1) / other.camera.intrinsics.focal_px**2
    )
    return np.asarray(np.sum(ones * by_one, axis=1) / np.maximum(noise, 1e-12))

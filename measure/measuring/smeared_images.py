"""Images blurred along one direction, as by a stand that shakes: edges of balls are wide there.

A ball that moves while the shutter is open is blurred along its own path, by a share of its step
from image to image. What stays the same whichever way balls move is none of theirs: it moves
outlines by more than the scatter of their edges says.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from measure.arrays import Bytes, Floats
from measure.limits import FEWEST, HUBER_SIGMAS, SIGNIFICANT_SIGMAS, TINY
from measure.measuring.woven_images import BallStep
from measure.model import Detection

_LEAST_PX = 7.0
"""A shorter blur is not reported: shading and compression widen edges unevenly by up to 6 px."""
_SECTORS, _RAYS, _FEWEST = 16, 4, 10
"""Parts of an outline, of so many rays each, and how many must stand out."""
_RISE_PX = 4  # Over which a slope is measured: noise makes the steepest of shorter ones too steep
_REACH, _REACH_PX = 0.3, 12.0
"""How far to both sides an edge is sampled at most, in radii and in px: shading is wider."""
_LEAST_STEP = 15.0  # Levels between both sides of an edge whose width is known
_REMEMBERED = 90  # Outlines of a camera
_ROUNDS = 5  # Of weighting again: a shadow or another ball lies beside some edges
SHARP_CAMERAS = 2  # From which on a pose rests on cameras without blur as well
_TEXT = re.compile(r"pictures of (.+?) are blurred by (\d+) px along a line at (-?\d+) deg")


@dataclass(frozen=True)
class Smear:
    """The blur of some cameras' images along one direction."""

    cameras: tuple[str, ...]
    width_px: float  # of edges across it, the largest of the cameras'
    angle_deg: float  # the direction, from the rows towards the columns

    def __str__(self) -> str:
        names = ", ".join(self.cameras)
        return (
            f"pictures of {names} are blurred by {self.width_px:.0f} px along a line at "
            f"{round(self.angle_deg)} deg to their rows"
        )


class SmearedImages:
    """Judges the latest images of each camera by the edges of balls found in them.

    Attributes:
        smear: the cameras whose images are blurred, beyond chance and whichever way balls move.
    """

    def __init__(self) -> None:
        self._edges: dict[str, deque[tuple[Floats, Floats]]] = {}
        self.smear: Smear | None = None

    def add(self, steps: Sequence[BallStep]) -> None:
        """Look at the edges of balls that were seen in two images in a row."""
        for ball, pixels, step_px in steps:
            edges = _edges(pixels, ball)
            if edges is not None:
                latest = self._edges.setdefault(ball.camera, deque(maxlen=_REMEMBERED))
                latest.append((edges, step_px))
        if steps:
            self.smear = self._judged()

    def _judged(self) -> Smear | None:
        found = {name: _smear(latest) for name, latest in self._edges.items()}
        known = {name: smear for name, smear in found.items() if smear is not None}
        if not known:
            return None
        return Smear(tuple(sorted(known)), *max(known.values()))

    def doubt(self, used: Collection[str]) -> tuple[str, bool]:
        """The note on a pose that rests on some cameras, and whether that flags it."""
        smear = self.smear
        if smear is None or not {*used} & {*smear.cameras}:
            return "", False
        return str(smear), len({*used} - {*smear.cameras}) < SHARP_CAMERAS


def smear_in(reasons: Iterable[str]) -> Smear | None:
    """The blur that texts of measurements name last."""
    matches = [match for reason in reasons for match in _TEXT.finditer(reason)]
    if not matches:
        return None
    names = {name for match in matches for name in match[1].split(", ")}
    return Smear(tuple(sorted(names)), float(matches[-1][2]), float(matches[-1][3]))


def _smear(latest: Sequence[tuple[Floats, Floats]]) -> tuple[float, float] | None:
    """Width in px and direction in deg of a blur that no motion of the balls makes.

    Squares of widths are w^2 + (l cos)^2 + (e v cos)^2, with a blur of l px along one direction and
    an exposure of e steps v; the cosines of twice the angles leave two numbers of each outline.
    """
    if len(latest) < FEWEST:
        return None
    edges, steps = (np.array(column) for column in zip(*latest, strict=True))
    x, y = steps.T
    one, none = np.ones(len(x)), np.zeros(len(x))
    design = np.concatenate(
        [np.stack([one, none, (x**2 - y**2) / 2], axis=1), np.stack([none, one, x * y], axis=1)]
    )
    values, covariance = _robust(design, edges[:, 1:].T.ravel())
    uneven = float(np.hypot(*values[:2]))  # l^2 / 2
    along = values[:2] / max(uneven, TINY)
    sd = float(np.sqrt(along @ covariance[:2, :2] @ along))
    if np.sqrt(2 * uneven) < _LEAST_PX or uneven < SIGNIFICANT_SIGMAS * sd:
        return None
    width_px = float(np.sqrt(max(np.median(edges[:, 0]) + uneven, 0)))
    return width_px, float(np.degrees(np.arctan2(values[1], values[0])) / 2)


def _edges(pixels: Bytes, ball: Detection) -> Floats | None:
    """Squares of widths (px^2) of a ball's edge: mean, and the parts as cos and sin of twice (3,).

    A width is the step of brightness over the edge through its steepest slope. None if too little
    of the edge is in the image, or stands out.
    """
    (x, y), r = ball.center_px.tolist(), ball.radius_px
    angles = 2 * np.pi * np.arange(_SECTORS * _RAYS) / (_SECTORS * _RAYS)
    reach = min(_REACH * r, _REACH_PX)
    radii = np.arange(r - reach, r + reach)
    u = x + np.cos(angles)[:, None] * radii
    v = y + np.sin(angles)[:, None] * radii
    height, width = np.asarray(pixels).shape[:2]
    left, top = int(u.min()), int(v.min())
    if len(radii) < FEWEST or left < 0 or top < 0 or u.max() > width - 1 or v.max() > height - 1:
        return None
    part = np.asarray(pixels)[top : int(v.max()) + 2, left : int(u.max()) + 2]
    grey = cv2.cvtColor(part, cv2.COLOR_BGR2GRAY).astype(np.float32)
    at_u, at_v = (u - left).astype(np.float32), (v - top).astype(np.float32)
    rays = cv2.remap(grey, at_u, at_v, cv2.INTER_LINEAR).astype(np.float64)
    light = rays.reshape(_SECTORS, _RAYS, -1).mean(axis=1)
    slopes = np.abs(light[:, _RISE_PX:] - light[:, :-_RISE_PX]).max(axis=1) / _RISE_PX
    sides = max(len(radii) // 4, 2)
    step = np.abs(light[:, :sides].mean(axis=1) - light[:, -sides:].mean(axis=1))
    clear = step > _LEAST_STEP
    if np.count_nonzero(clear) < _FEWEST:
        return None
    twice = 2 * angles.reshape(_SECTORS, _RAYS).mean(axis=1)
    parts = np.stack([np.ones(_SECTORS), np.cos(twice), np.sin(twice)], axis=1)
    return _robust(parts[clear], (step[clear] / slopes[clear]) ** 2)[0]


def _robust(design: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Parameters and covariance of a linear model (n, k) of values (n,), by Huber's weights."""
    weights, ridge = np.ones(len(values)), 1e-9 * np.eye(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (weights[:, None] * design) + ridge
        found = np.linalg.solve(normal, design.T @ (weights * values))
        left = np.abs(values - design @ found)
        sd = max(1.48 * float(np.median(left)), TINY)  # of a Gaussian, by its median
        weights = 1 / np.maximum(left / (HUBER_SIGMAS * sd), 1)
    return np.asarray(found, np.float64), np.asarray(sd**2 * np.linalg.inv(normal), np.float64)

"""What marker formats show: the located balls and the body's origin at every frame set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.results.columns import integers, numbers, texts
from measure.results.run import Run

ORIGIN = "body_origin"


@dataclass(frozen=True, eq=False)
class Markers:
    """Markers over time.

    Attributes:
        names: of the k markers: the balls, then the body's origin.
        times_s: (n,) of the frame sets.
        points_mm: (n, k, 3) in the world, NaN where one was not located.
        rate_hz: frame sets a second, by the median step.
    """

    names: tuple[str, ...]
    times_s: Floats
    points_mm: Floats
    rate_hz: float


def markers_of(run: Run) -> Markers:
    """The markers of a run: balls as triangulated, the origin from the pose."""
    names = (*run.body.names, ORIGIN)
    points = np.full((len(run.times_s), len(names), 3), np.nan)
    table = run.balls
    rows = integers(table, "index")
    columns = np.array([names.index(ball) for ball in texts(table, "ball")], dtype=np.int64)
    points[rows, columns] = numbers(table, "x_mm", "y_mm", "z_mm")
    points[run.has_pose, -1] = run.world_from_body.translation
    steps = np.diff(run.times_s)
    rate = 1 / float(np.median(steps)) if len(steps) else 1.0
    return Markers(names, run.times_s, points, rate)

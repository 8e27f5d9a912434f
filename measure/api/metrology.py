"""What a laboratory makes of poses: rests, a tool's tip, a frame of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measure.arrays import Floats
from measure.errors import ConfigError, DegenerateGeometryError, RunError
from measure.metrology.pivot import Pivot, SpinAxis, find_spin_axis, find_tip
from measure.metrology.rests import SHORTEST_S, Rests
from measure.model import Body
from measure.results import read_run
from measure.results.pose_table import poses_of, rests_of, shared_errors


@dataclass(frozen=True, eq=False)
class TipResult:
    """A tool's tip."""

    pivot: Pivot  # the tip, its uncertainty, how it was found
    axis: SpinAxis | None  # the tool's axis; None if none was asked for
    body: Body  # the body with its origin at the tip, and its z along the axis if there is one


def rests(run: Path | str, shortest_s: float = SHORTEST_S, body: str | None = None) -> Rests:
    """The stretches of a run in which a body, of several the named one, stands still."""
    if not 0 < shortest_s < np.inf:
        raise ConfigError(f"--shortest-s {shortest_s:g}: give the seconds of the shortest rest")
    return rests_of(read_run(Path(run), body), shortest_s)


def pivot(run: Path | str, spin: Path | str | None = None, body: str | None = None) -> TipResult:
    """The tip of a tool that was turned about it.

    Args:
        run: the run's folder: the tool pivots about its tip and does nothing else.
        spin: another run, of the tool spun about its own axis.
        body: the tool's name, in a run of several bodies.

    Raises:
        RunError: no run, or its motion cannot show the tip or the axis.
    """
    opened = read_run(Path(run), body)
    with told_of(run):
        found = find_tip(poses_of(opened), shared_errors(opened))
    turn, axis = np.eye(3), None
    if spin is not None:
        spun = read_run(Path(spin), body)
        with told_of(spin):
            axis = find_spin_axis(poses_of(spun), shared_errors(spun), found.tip_mm)
        turn = _turn_to_z(axis)
    centers = (opened.body.centers - found.tip_mm) @ turn.T
    return TipResult(found, axis, opened.body.with_centers(centers))


@contextmanager
def told_of(run: Path | str) -> Iterator[None]:
    """Name the run in what its poses do not determine."""
    try:
        yield
    except DegenerateGeometryError as problem:
        raise RunError(f"{run}: {problem}") from None


def _turn_to_z(axis: SpinAxis) -> Floats:
    """The rotation (3, 3) that brings the axis to z and leaves x as near as it can."""
    z = axis.direction
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])

"""Which images of the cameras belong to one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Bools, Floats, Ints

GAP_PERIODS = 1.5
"""A step of the reference clock longer than this many periods holds missing frames."""


@dataclass(frozen=True, eq=False)
class Pairing:
    """Frame sets as positions in the streams."""

    positions: Ints  # (sets, cameras) position in each camera's stream, -1 for no image
    times_s: Floats  # (sets,) mean time of each set's images, increasing
    reference: int  # index of the camera whose clock set the instants
    tolerance_s: float  # the largest accepted distance from an instant


def pair_nearest(
    times_s: Sequence[Floats], tolerance_s: float | None = None, reference: int | None = None
) -> Pairing:
    """Pair images by nearest time.

    The instants are the stamps of the reference camera: the first whose median period is within 1 %
    of the median (of an even number the longer) of all cameras' periods, so that neither a slow
    camera thins the others out nor a fast one makes sets of its own. Instants it missed (gaps, and
    the time before it started or after it ended) are filled in at its period where at least two
    other cameras have an image. Each image goes to the instant nearest to it, each instant takes
    the nearest of a camera's images, and no image is used twice.

    Args:
        times_s: per camera, (n,) increasing.
        tolerance_s: half the reference camera's median period if omitted.
        reference: index of the reference camera, to overrule the choice.
    """
    periods = [float(np.median(np.diff(t))) if len(t) > 1 else np.inf for t in times_s]
    if reference is None:
        middle = sorted(periods)[len(periods) // 2]
        alike = [p == middle or 0.99 < p / middle < 1.01 for p in periods]
        reference = alike.index(True)
    period = periods[reference]
    if tolerance_s is None:
        tolerance_s = period / 2
    instants, real = _instants(times_s, reference, period)
    positions = np.stack([_nearest(t, instants, tolerance_s) for t in times_s], axis=1)
    count = (positions >= 0).sum(axis=1)
    keep = (real & (count > 0)) | (count >= 2)
    positions = positions[keep]
    return Pairing(positions, _mean_times(times_s, positions), reference, float(tolerance_s))


def seldom_paired(names: Sequence[str], counts: Sequence[int], pairing: Pairing) -> list[str]:
    """A line for every camera of which most pictures are left over while most sets lack one.

    A fast camera leaves pictures over and a slow one lacks them; both at once mean another clock.
    """
    sets = len(pairing.times_s)
    used = (pairing.positions >= 0).sum(axis=0).tolist()
    return [
        f"camera {name}: {count - here} of {count} pictures belong to no frame set, and "
        f"{sets - here} of {sets} frame sets have none of it: do its stamps hold seconds, on the "
        "clock of the others?"
        for name, count, here in zip(names, counts, used, strict=True)
        if here < count / 2 and here < sets / 2
    ]


def _instants(times_s: Sequence[Floats], reference: int, period: float) -> tuple[Floats, Bools]:
    """The reference's stamps and, where it has none, those next to other cameras' images."""
    own = times_s[reference]
    if not np.isfinite(period):
        return own, np.ones(len(own), bool)
    others = np.concatenate(list(times_s))
    before = own[0] - period * _neighbours((own[0] - others) / period)
    after = own[-1] + period * _neighbours((others - own[-1]) / period)
    between = []
    for i in np.flatnonzero(np.diff(own) > GAP_PERIODS * period):
        steps = round((own[i + 1] - own[i]) / period)
        step = (own[i + 1] - own[i]) / steps
        inside = others[(others > own[i]) & (others < own[i + 1])]
        missed = _neighbours((inside - own[i]) / step)
        between.append(own[i] + step * missed[missed < steps])
    virtual = np.concatenate([before, after, *between])
    instants = np.concatenate([own, virtual])
    real = np.arange(len(instants)) < len(own)
    order = np.argsort(instants, kind="stable")
    return instants[order], real[order]


def _neighbours(steps: Floats) -> Floats:
    """The whole numbers from 1 on next to these numbers, each once."""
    whole = np.unique(np.concatenate([np.floor(steps), np.ceil(steps)]))
    return whole[whole >= 1]


def _nearest(times: Floats, instants: Floats, tolerance_s: float) -> Ints:
    """For each instant the position of its image, or -1."""
    right = np.clip(np.searchsorted(instants, times), 1, max(len(instants) - 1, 1))
    right = np.minimum(right, len(instants) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(times - instants[left]) <= np.abs(times - instants[right])
    home = np.where(closer_left, left, right)
    distance = np.abs(times - instants[home])
    out = np.full(len(instants), -1, dtype=np.int64)
    # Written from the farthest to the nearest, so the nearest of several stays.
    for i in np.argsort(-distance, kind="stable"):
        if distance[i] <= tolerance_s * (1 + 1e-9):
            out[home[i]] = i
    return out


def _mean_times(times_s: Sequence[Floats], positions: Ints) -> Floats:
    pairs = zip(times_s, positions.T, strict=True)
    stacked = [np.where(at >= 0, times[at], np.nan) for times, at in pairs]
    return np.nanmean(stacked, axis=0) if len(positions) else np.zeros(0)

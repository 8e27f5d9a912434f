"""How wrong a camera's stamps are by themselves: rounded, of arrival, of another unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import SessionError

_QUANTA_S = (1.0, 0.1, 0.05, 0.04, 0.02, 0.016, 1 / 64, 0.01, 0.008, 0.005, 0.004, 0.002, 0.001)
_ROUNDED = 0.01  # Of a quantum, or a period: what is nearer to its multiples is one of them
_MIN_STAMPS, _GAP_PERIODS = 8, 1.5
_ARRIVAL_CORRELATION = -0.25
"""Of neighbouring steps: a late stamp lengthens one and shortens the next, which gives -0.5."""
_WORTH_A_LINE_S, _MAX_UNEVEN, _MAX_PERIOD_S = 1e-3, 0.1, 10.0
"""Errors, steps (in periods) and periods that are noted."""


@dataclass(frozen=True, eq=False)
class StampErrors:
    """What a camera's stamps show of their own errors."""

    sd_s: Floats  # (n,) standard deviation of each
    notes: tuple[str, ...] = ()  # what a user should know, without the camera's name

    @classmethod
    def of(cls, times_s: Floats) -> StampErrors:
        """Judge stamps (n,), increasing.

        The covariance of neighbouring steps is minus the variance of the stamps' errors if these
        are independent, whatever the steps' own changes (a moving average; Box & Jenkins 1976,
        section 3.3). A single late stamp counts with what it is off its neighbours.
        """
        sd, steps = np.zeros(len(times_s)), np.diff(times_s)
        if len(times_s) < _MIN_STAMPS:
            return cls(sd)
        period, notes = float(np.median(steps)), []
        whole = np.maximum(np.rint(steps / period), 1.0)
        off = steps - whole * period
        if quantum := _quantum_s(times_s, period):
            sd += quantum / math.sqrt(12)
            if sd[0] > _WORTH_A_LINE_S:
                notes.append(
                    f"stamps are rounded to {1e3 * quantum:.4g} ms: poses allow for "
                    f"{1e3 * sd[0]:.1f} ms; write more digits if they are known"
                )
        uneven = float(np.std(off[steps < _GAP_PERIODS * period]))
        off = off - np.median(off)
        jitter = math.sqrt(max(-float(np.mean(off[1:] * off[:-1])), 0.0))
        arrived = jitter**2 > -_ARRIVAL_CORRELATION * float(np.mean(off**2))
        arrived &= jitter > max(1.5 * float(sd[0]), 0.1 * _WORTH_A_LINE_S)
        if arrived:
            span = times_s[2:] - times_s[:-2]
            both = np.maximum(np.rint(span / period), 2.0)
            line = times_s[:-2] + span * np.clip(whole[:-1], 1.0, both - 1) / both
            alone = np.pad(np.abs(times_s[1:-1] - line), 1)
            typical = max(1.06 * float(np.median(np.abs(off))), float(sd[0]))
            sd = np.hypot(typical, np.where(alone > 3 * typical, alone, 0.0))
        if period > _MAX_PERIOD_S:
            notes.append(
                f"{period:.1f} s from picture to picture: are the times milliseconds? Write "
                "seconds, or head the column time_ms"
            )
        elif uneven > _MAX_UNEVEN * period or (arrived and jitter > _WORTH_A_LINE_S):
            allowed = f"; poses allow for {1e3 * np.median(sd):.1f} ms" if arrived else ""
            notes.append(
                f"stamps {1e3 * uneven:.1f} ms uneven about {1e3 * period:.1f} ms: are they the "
                f"middles of the exposures, or arrival times?{allowed}"
            )
        return cls(sd, tuple(notes))


def _quantum_s(times_s: Floats, period_s: float) -> float:
    """What the stamps are rounded to; 0 if nothing shows it, as where every step is the same."""

    def multiples(values: Floats, unit: float) -> bool:
        return bool(np.all(np.abs(values / unit - np.rint(values / unit)) < _ROUNDED))

    if multiples(np.diff(times_s), period_s):
        return 0.0
    return next((q for q in _QUANTA_S if multiples(times_s - times_s[0], q)), 0.0)


def check_time_units(periods_s: Mapping[str, float]) -> None:
    """Refuse (SessionError) cameras whose stamps, by their median steps, are in different units."""
    known = sorted((period, name) for name, period in periods_s.items() if np.isfinite(period))
    ratio = known[-1][0] / known[0][0] if known else 1.0
    if any(abs(ratio / factor - 1) < 0.1 for factor in (1e3, 1e6, 1e9)):
        raise SessionError(
            f"pictures of camera '{known[-1][1]}' are {known[-1][0]:.4g} s apart by their stamps, "
            f"of '{known[0][1]}' {known[0][0]:.4g} s: one is in another unit; write seconds, or "
            "head the column by its unit (time_ms, time_us, time_ns)"
        )

"""Frames that are missing, and stamps that do not run evenly."""

from __future__ import annotations

import numpy as np

from measure.arrays import Floats, Ints
from measure.measuring.checks.finding import Finding, Level

_DROPPED = 1.5
_UNEVEN = 0.1
_MOST_DROPPED = 0.02
_SLOWEST_S = 10.0
"""Pictures further apart are rather stamped in milliseconds than taken by hand."""


def stamp_findings(camera: str, times_s: Floats, frames: Ints) -> list[Finding]:
    """Look at one camera's time stamps.

    Args:
        camera: its name.
        times_s: (n,) stamps, increasing.
        frames: (n,) frame numbers.
    """
    if len(times_s) < 3:
        return [Finding(Level.WEAK, "frames", f"{camera}: only {len(times_s)} frames")]
    steps = np.diff(times_s)
    period = float(np.median(steps))
    gaps = np.nonzero(steps > _DROPPED * period)[0]
    lost = int(np.sum(np.rint(steps[gaps] / period) - 1))
    out = []
    if period > _SLOWEST_S:
        text = f"{camera}: {period:.1f} s from picture to picture: are the times milliseconds?"
        out.append(Finding(Level.WEAK, "clock", f"{text} Write seconds"))
    if lost:
        worst = int(gaps[np.argmax(steps[gaps])])
        share = lost / (len(times_s) + lost)
        out.append(
            Finding(
                Level.WEAK if share > _MOST_DROPPED else Level.NOTE,
                "frames",
                f"{camera}: {lost} frames dropped ({100 * share:.1f} %), the longest gap "
                f"{steps[worst]:.3f} s after frame {frames[worst]} at {times_s[worst]:.3f} s",
            )
        )
    even = np.delete(steps, gaps)
    jitter = float(np.std(even - np.median(even)))
    if jitter > _UNEVEN * period:
        out.append(
            Finding(
                Level.WEAK,
                "clock",
                f"{camera}: stamps {1e3 * jitter:.1f} ms uneven about {1e3 * period:.1f} ms: "
                "are they the middles of the exposures, or arrival times?",
            )
        )
    return out

"""Hysteresis that play operators do not hold: Maxwell slip that creeps back, and slow drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats

_ELEMENTS = np.array([0.25, 0.5, 1.0, 2.0])  # slip limits, over their mean share of the size


@dataclass(frozen=True)
class Slip:
    """What is added to the links of the seven drives; all assumptions.

    A Maxwell element is a spring that slips at a limit (Rizos and Fassois 2004). Here each also
    relaxes, so that the error depends on the rate of the motion and creeps at rest.

    Attributes:
        size: largest error by the elements together, rad (m).
        relaxation_s: time constant in which a loaded element creeps back.
        drift: error that temperature and tension add in the long run, rad (m).
        drift_s: time constant of the drift.
    """

    size: tuple[float, ...]
    relaxation_s: float = 8.0
    drift: tuple[float, ...] = (0.0,) * 7
    drift_s: float = 900.0

    def errors(self, links: Floats, step_s: float) -> Floats:
        """(n, 7) to be added to link positions (n, 7), rad and m."""
        limits = _ELEMENTS[:, None] * np.array(self.size) / _ELEMENTS.sum()
        kept = float(np.exp(-step_s / self.relaxation_s))
        moves = np.diff(links, axis=0, prepend=links[:1])
        out, loaded = np.empty_like(links), np.zeros_like(limits)
        for index, move in enumerate(moves):
            loaded = np.clip(kept * loaded + move, -limits, limits)
            out[index] = loaded.sum(axis=0)
        times = step_s * np.arange(len(links))[:, None]
        return np.asarray(-out + (1.0 - np.exp(-times / self.drift_s)) * np.array(self.drift))

"""What `measure demo` shows of this package: a robot corrected by the shipped network."""

from __future__ import annotations

from dataclasses import asdict

from measure.api import Addition
from measure_learning.api import correct_simulated_robot

ROBOT_S = 60.0  # How long the simulated robot moves


def correction() -> Addition:
    """Correct a minute of the simulated robot that the network has not seen."""
    found = correct_simulated_robot(ROBOT_S)
    rows = tuple(
        (f"{name} position, mm", score.rms_mm, score.p95_mm)
        for name, score in (("reported", found.before), ("corrected", found.after))
    )
    return Addition(
        "a simulated cable-driven robot, freshly switched on: where it believes its tip to be, and "
        "corrected by the shipped network, against the exact truth",
        ("error", "RMS", "95 % below"),
        rows,
        asdict(found),
    )

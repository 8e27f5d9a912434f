"""Measured lengths against known ones, after VDI/VDE 2634 part 1 and ASTM E3064 in spirit.

A rig passes while its length errors lie within what it says of itself: the expanded uncertainty U
of a single length is two standard deviations (k = 2). Of many lengths some exceed U by chance, so
that the rig is contradicted only beyond the wider k at which all of them together hold as often.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, stdtrit

from measure.arrays import Floats
from measure.metrology.rests import Rests

COVERAGE_FACTOR = 2.0
_COVERAGE = 2 * float(ndtr(COVERAGE_FACTOR)) - 1
_DEGREES = 50
"""Of freedom: a standard deviation is itself known to a tenth (GUM, JCGM 100:2008, G.4.2)."""


@dataclass(frozen=True, eq=False)
class MeasuredLengths:
    """n lengths as a rig measures them."""

    lengths_mm: Floats  # (n,)
    covariance: Floats  # (n, n) in mm^2
    middles_mm: Floats  # (n, 3) where, in the world
    single_sd_mm: Floats  # (n,) of a length from two single poses, by their scatter


@dataclass(frozen=True, eq=False)
class Acceptance:
    """Lengths judged."""

    names: tuple[str, ...]  # n of them
    known_mm: Floats  # (n,)
    length_errors_mm: Floats  # (n,) measured minus known
    expanded_mm: Floats  # (n,) expanded uncertainties of the errors, k = 2
    middles_mm: Floats  # (n, 3) where, in the world
    rms_mm: float
    max_mm: float  # largest absolute error
    repeatability_mm: float  # standard deviation with which a length comes again
    repeated: int  # how many lengths were repeated; 0: repeatability is by scatter at rest
    scale: float  # measured over known, less 1
    scale_expanded: float  # its expanded uncertainty, k = 2
    limit: float  # factor k beyond which one of so many lengths contradicts
    doubts: tuple[str, ...]  # what the rig already says against itself

    @property
    def ratios(self) -> Floats:
        """Errors (n,) over their expanded uncertainties."""
        return self.length_errors_mm / self.expanded_mm

    @property
    def worst(self) -> int:
        """The length whose error is largest in its expanded uncertainty."""
        return int(np.argmax(np.abs(self.ratios)))

    @property
    def repeated_words(self) -> str:
        """What repeatability is here."""
        return "repeatability" if self.repeated else "single length's SD by scatter at rest"

    @property
    def sentence(self) -> str:
        """The test in a sentence."""
        return (
            f"{len(self.known_mm)} lengths are off by {self.rms_mm:.3f} mm RMS and "
            f"{self.max_mm:.3f} mm at most; {self.repeated_words} {self.repeatability_mm:.3f} mm; "
            f"scale {100 * self.scale:+.3f} % +- {100 * self.scale_expanded:.3f} % (k = 2)."
        )

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What cannot be by chance, a line each; empty if the rig is as good as it says."""
        wide = self.limit / COVERAGE_FACTOR
        lines = [doubt.removeprefix("wrong: ") for doubt in self.doubts]
        lines += [
            f"length {name}: off by {error:+.3f} mm, more than {wide * U:.3f} mm"
            for name, error, U in zip(
                self.names, self.length_errors_mm, self.expanded_mm, strict=True
            )
            if abs(error) > wide * U
        ]
        if len(self.known_mm) > 1 and abs(self.scale) > wide * self.scale_expanded:
            lines.append(
                f"scale: lengths are {100 * self.scale:+.2f} % off, +- "
                f"{100 * self.scale_expanded:.2f} % (k = 2): calibration or body file is wrong"
            )
        return tuple(lines)


def between_rests(rests: Rests, pairs: Sequence[tuple[int, int]]) -> MeasuredLengths:
    """Distances of the body's origin between rests, by their numbers."""
    n = len(pairs)
    found = [rests.displacement(a, b) for a, b in pairs]
    J, middles, single = np.zeros((n, 6 * len(rests))), np.zeros((n, 3)), np.zeros(n)
    for row, ((a, b), moved) in enumerate(zip(pairs, found, strict=True)):
        along = moved.shift_mm / max(moved.distance_mm, 1e-12)
        J[row, 6 * b : 6 * b + 3], J[row, 6 * a : 6 * a + 3] = along, -along
        ends = [rests.rests[k] for k in (a, b)]
        middles[row] = np.mean([end.world_from_body.translation for end in ends], axis=0)
        single[row] = np.sqrt(sum(along @ end.scatter[:3, :3] @ along for end in ends))
    lengths = np.array([moved.distance_mm for moved in found])
    return MeasuredLengths(lengths, J @ rests.covariance @ J.T, middles, single)


def judge(
    names: Sequence[str],
    measured: MeasuredLengths,
    known_mm: Floats,
    known_sd_mm: Floats,
    doubts: tuple[str, ...] = (),
) -> Acceptance:
    """Compare n measured lengths with known ones (n,) and their standard deviations (n,).

    What the rig already says against itself, its `doubts`, are contradictions as well.
    """
    errors = measured.lengths_mm - known_mm
    P = measured.covariance + np.diag(known_sd_mm**2)
    square = float(known_mm @ known_mm)
    # As many tests as lengths, and one of their scale; none of them may fail by chance (Sidak).
    tests = len(known_mm) + (len(known_mm) > 1)
    groups = [errors[known_mm == length] for length in np.unique(known_mm)]
    degrees = sum(len(group) - 1 for group in groups)
    if degrees:
        again = float(np.sqrt(sum(len(g) * np.var(g) for g in groups) / degrees))
    else:
        again = float(np.sqrt(np.mean(measured.single_sd_mm**2)))
    return Acceptance(
        tuple(names),
        known_mm,
        errors,
        COVERAGE_FACTOR * np.sqrt(np.diag(P)),
        measured.middles_mm,
        float(np.sqrt(np.mean(errors**2))),
        float(np.max(np.abs(errors))),
        again,
        degrees + len([g for g in groups if len(g) > 1]),
        float(known_mm @ errors) / square,
        COVERAGE_FACTOR * float(np.sqrt(known_mm @ P @ known_mm)) / square,
        float(stdtrit(_DEGREES, (1 + _COVERAGE ** (1 / tests)) / 2)),
        doubts,
    )

"""Whether `measure mend` mends drawn faults, and makes nothing worse.

    python -m benchmarks.mend [--count 16] [--seed 1] [--only NAME]

Scenes, kinds of faults, amounts, cameras and balls are drawn (`drawn_faults`), of the kinds that
cameras, body or stamps can be mended of. Each recording is mended; it and the mended one are
measured and compared with the truth. Printed are, of the faults that `check` names right, those
whose residuals at kept-out instants end within 1.2 times the healthy recording's and whose balls'
places, at poses without a flag, err by at most 2 times as much; how many were refused; and how many
were made worse.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.drawn_faults import HZ, SETS, drawn, scenes
from benchmarks.errors import rms, truth_of
from benchmarks.rig_faults import Fault, copied
from measure import api
from measure.calibration.refining.recording import ball_places
from measure.checking.mending import MENDS
from measure.host import Registry
from measure.results import read_run
from measure.results.pose_table import poses_of
from measure.session import read_body
from tests.simulated.sessions import rendered

_RESIDUAL, _ERROR = 1.2, 2.0
"""Times the healthy recording's, within which kept-out residuals and the poses' errors end."""
_WORSE = 1.1  # Times the error of before, from which on a recording was made worse
_MISSING = 0.1  # Share of poses without a flag that a mended recording may lack


@dataclass(frozen=True)
class Errors:
    """What the balls' places err by at poses without a flag, and how many of these there are.

    The balls, and not the body's origin: no picture of three balls shows by how much the body
    file's plane of them is turned.
    """

    rms_mm: float
    poses: int


def errors(session: Path, out: Path, source: Path, registry: Registry) -> Errors:
    """Measure a session, and compare with the truth of its source."""
    api.run(session, out, api.load_profile(), registry, api.RunOptions(recording=False))
    poses = poses_of(read_run(out))
    if not len(poses):
        return Errors(np.inf, 0)
    used, true = (read_body(folder / "body.toml").centers for folder in (session, source))
    there = ball_places(truth_of(source).at(poses.times_s), true)
    return Errors(rms(ball_places(poses.world_from_body, used) - there), len(poses))


@dataclass(frozen=True)
class Trial:
    """One fault, mended."""

    named: bool
    mended: bool  # residuals and errors as of a healthy recording
    refused: bool
    worse: bool
    line: str


def tried(source: Path, fault: Fault, healthy: tuple[float, Errors], registry: Registry) -> Trial:
    """Make a fault, mend it and measure."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / source.name
        copied(source, folder)
        fault.change(folder)
        out = Path(scratch) / "mended"
        found = api.mend(folder, out, registry)
        codes = [change.code for change in found.changed]
        if not codes:
            causes = api.check(folder, registry).causes
            codes = [str(cause.cause) for cause in causes[:1]]
        named = bool(codes) and codes[0] in fault.causes
        before = errors(folder, Path(scratch) / "before", source, registry)
        after = Errors(np.inf, 0)
        if not found.refused:
            after = errors(out, Path(scratch) / "after", source, registry)
        residual, well = healthy
        good = not found.refused and (found.after.residual_sd or np.inf) < _RESIDUAL * residual
        good = good and after.rms_mm < _ERROR * well.rms_mm
        good = good and after.poses > (1 - _MISSING) * well.poses
        worse = not found.refused and after.rms_mm > _WORSE * max(before.rms_mm, well.rms_mm)
        told = (
            f"{', '.join(codes)}; kept-out residuals {found.before.residual_sd} -> "
            f"{found.after.residual_sd} SD, healthy {residual:.2f}; errors {before.rms_mm:.3f} mm "
            f"({before.poses}) -> {after.rms_mm:.3f} mm ({after.poses}), healthy "
            f"{well.rms_mm:.3f} mm; {found.refused}"
        )
        return Trial(named, good, bool(found.refused), worse, told)


def main() -> None:
    """Print a line for each fault, and the counts."""
    parser = argparse.ArgumentParser(prog="benchmarks.mend", description=__doc__)
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="faults whose name matches this")
    options = parser.parse_args()
    registry, known = Registry.discover(), {str(word) for word in MENDS}
    every = []
    for scene in scenes():
        source = rendered(scene, np.arange(SETS) / HZ)
        some = (f for f in drawn(source, options.seed) if f.causes and {*f.causes} <= known)
        every += [(source, fault) for fault in some if re.search(options.only, fault.name)]
    order = np.random.default_rng(options.seed).permutation(len(every))[: options.count]
    healthy: dict[Path, tuple[float, Errors]] = {}
    trials = list[Trial]()
    for source, fault in (every[k] for k in order):
        if source not in healthy:
            with tempfile.TemporaryDirectory() as scratch:
                plain = api.mend(source, Path(scratch) / "plain", registry)
                well = errors(source, Path(scratch) / "run", source, registry)
                healthy[source] = plain.before.residual_sd or np.inf, well
        trial = tried(source, fault, healthy[source], registry)
        trials.append(trial)
        word = "mended" if trial.mended else "refused" if trial.refused else "MISSED"
        named = "" if trial.named else "(named wrongly) "
        worse = "WORSE " if trial.worse else ""
        print(f"{word:8}{worse}{source.name} {fault.name}: {named}{trial.line}", flush=True)
    right = [trial for trial in trials if trial.named]
    print(
        f"named right: {len(right)} of {len(trials)}; of these mended to {_RESIDUAL} times the "
        f"healthy residual and {_ERROR} times the healthy error: "
        f"{sum(t.mended for t in right)}, refused {sum(t.refused for t in right)}; made worse: "
        f"{sum(t.worse for t in trials)} of {len(trials)}"
    )


if __name__ == "__main__":
    run_command(main)

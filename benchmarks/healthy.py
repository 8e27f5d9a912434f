"""How often a healthy recording is called wrong, and how many of its poses are flagged.

    python -m benchmarks.healthy [--count N] [--seed SEED] [--only TEXT]

Nothing is wrong in these recordings: rendered scenes, and path-traced ones beside the repository
where they are; as they are, as JPEG of less quality, as H.264 and HEVC videos with half as many
colours as pixels; with grain, of some cameras, of some length. So many of all combinations are
drawn. For each the first cause of `measure check` is printed, and the share of frame sets that
`measure run` flags; at last how many were called wrong, weak, and flagged in more than 2 %.
"""

from __future__ import annotations

import argparse
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.drawn_faults import HZ, SETS, scenes
from benchmarks.recordings import recordings_beside
from benchmarks.rig_faults import Change, copied, cut, encoded, grainy, kept_cameras, squeezed
from measure import api
from measure.checking import Level
from measure.host import Registry
from measure.session import open_session, read_calibration
from tests.simulated.sessions import rendered

MAX_FLAGGED_SHARE = 0.02
CODECS: dict[str, Change | None] = {
    "as it is": None,
    **{f"JPEG {quality}": squeezed(quality) for quality in (85, 60)},
    **{f"H.264 {crf}": encoded("libx264", crf) for crf in (16, 20, 23, 28)},
    **{f"HEVC {crf}": encoded("libx265", crf) for crf in (20, 26)},
}
GRAIN_LEVELS = (0.0, 3.0, 8.0)
CAMERAS = ("all", "all but one", "two")
LENGTHS = (SETS, 12)


@dataclass(frozen=True)
class Recording:
    """One healthy recording."""

    source: str
    codec: str  # of `CODECS`
    grain: float  # standard deviation, in levels
    cameras: str  # of `CAMERAS`
    sets: int  # at most

    def make(self, source: Path, folder: Path, seed: int) -> None:
        """Write it into a folder that is not there yet; the same whatever else is drawn."""
        copied(source, folder)
        rng = np.random.default_rng([seed, zlib.crc32(str(self).encode())])
        names = [camera.name for camera in read_calibration(folder / "calibration.toml").cameras]
        fewest = {"all": len(names), "all but one": max(len(names) - 1, 2), "two": 2}[self.cameras]
        first = int(rng.integers(len(names)))
        kept_cameras(*(names[(first + k) % len(names)] for k in range(fewest)))(folder)
        cut(0, self.sets)(folder)
        if self.grain:
            grainy(self.grain, int(rng.integers(2**31)))(folder)
        if (change := CODECS[self.codec]) is not None:
            change(folder)

    def __str__(self) -> str:
        return (
            f"{self.source}, {self.codec}, grain {self.grain:g}, {self.cameras}, {self.sets} sets"
        )


def sources() -> dict[str, Callable[[], Path]]:
    """What makes each recording, or finds it, by name."""
    own: dict[str, Callable[[], Path]]
    own = {s.name: partial(rendered, s, np.arange(SETS) / HZ) for s in scenes()}
    beside = recordings_beside()
    return own | {
        name: partial(Path, beside[name]) for name in beside if _is_of_one_body(beside[name])
    }


def _is_of_one_body(folder: Path) -> bool:
    with open_session(folder) as session:
        return not session.other_bodies


@dataclass(frozen=True)
class Answer:
    """What was said of one recording."""

    level: Level | None  # the worst of all causes and findings that are not only a note
    line: str  # its first words
    flagged: float  # share of frame sets


def answer(folder: Path, registry: Registry) -> Answer:
    """Check a recording and measure it."""
    found = api.check(folder, registry)
    worst = next((f for f in found.findings if f.level is Level.WRONG), None)
    causes = [cause.finding for cause in found.causes if cause.level is not Level.NOTE]
    worst = worst or next(iter(causes), None)
    without = api.RunOptions(recording=False)
    summary = api.run(folder, folder / "run", api.load_profile(), registry, without)
    flagged = summary.flagged / max(summary.frame_sets, 1)
    if worst is None:
        return Answer(None, "", flagged)
    return Answer(worst.level, worst.text[:100], flagged)


def main() -> None:
    """Print a line for each recording drawn, and the counts."""
    parser = argparse.ArgumentParser(prog="benchmarks.healthy", description=__doc__)
    parser.add_argument("--count", type=int, default=40, help="recordings drawn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="recordings whose line holds this text")
    options = parser.parse_args()
    rng, registry, known = np.random.default_rng(options.seed), Registry.discover(), sources()
    every = [Recording(*one) for one in product(known, CODECS, GRAIN_LEVELS, CAMERAS, LENGTHS)]
    every = [one for one in every if options.only in str(one)]
    drawn = rng.choice(len(every), min(options.count, len(every)), replace=False).tolist()
    given = list[Answer]()
    for number in drawn:
        recording = every[number]
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "recording"
            recording.make(known[recording.source](), made, options.seed)
            given.append(answer(made, registry))
        last = given[-1]
        print(f"{last.level or 'quiet':6}{last.flagged:5.0%} {recording}: {last.line}", flush=True)
    counts = {level: sum(one.level is level for one in given) for level in Level}
    many = sum(one.flagged > MAX_FLAGGED_SHARE for one in given)
    print(
        f"\n{len(given)} of {len(every)} recordings: {counts[Level.WRONG]} called wrong, "
        f"{counts[Level.WEAK]} weak; {many} flagged in more than {MAX_FLAGGED_SHARE:.0%}"
    )


if __name__ == "__main__":
    run_command(main)

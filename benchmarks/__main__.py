"""Print the table; with --out, write it as a page of the documentation."""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.methods import METHODS
from benchmarks.recordings import own_recordings, recordings_beside
from benchmarks.trial import Trial, run_trial
from measure.host import Registry
from measure.results import versions
from measure.session import open_session, read_trajectory

HEAD = (
    "recording",
    "method",
    "centre px",
    "position mm",
    "rotation deg",
    "no pose %",
    "wrong %",
    "flagged %",
    "in 95 % region",
    "first x ref",
    "later x ref",
)
WORDS = """# Benchmarks

Every method on every recording. RMS errors are over the frame sets that have a pose; *no pose*
counts those that have none, *wrong* those that the method believes although they are more than 2
mm off. Times are CPU time of one frame set, decoding apart, as a multiple of one
`cv2.cvtColor(BGR2HSV)` of one of its pictures: the first one (search) and the median of the later
ones. `own` recordings are rendered by `measure.simulation`; the others by a path tracer that is
not part of the program, and appear where they are at hand.

Made by `python -m benchmarks --out docs/benchmarks.md`, one default setting throughout.

"""


def main() -> None:
    """Run all trials."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument("--frames", type=int, default=24, help="frame sets per own scene")
    parser.add_argument("--cache", type=Path, help="folder for the rendered scenes")
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    parser.add_argument("--methods", default="", help="methods whose name contains this")
    parser.add_argument("--out", type=Path, help="write the table to this page")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.cache or Path(scratch)
        recordings = {**recordings_beside(), **own_recordings(folder, given.frames)}
        rows = []
        for row in _rows(recordings, given.only, given.methods):
            print("  ".join(row), file=sys.stderr, flush=True)
            rows.append(row)
    text = _markdown(rows)
    print(text)
    if given.out is not None:
        given.out.write_text(WORDS + text + _footer(), encoding="utf-8")


def _rows(recordings: dict[str, Path], only: str, methods: str) -> Iterator[tuple[str, ...]]:
    registry = Registry.discover()
    for name, path in recordings.items():
        if only not in name:
            continue
        truth = read_trajectory(path / "truth.csv")
        for method in METHODS:
            if methods in method.name:
                with open_session(path) as session:
                    yield name, method.name, *_cells(run_trial(method, session, truth, registry))


def _cells(trial: Trial) -> tuple[str, ...]:
    return (
        f"{trial.center_px:.3f}",
        f"{trial.position_mm:.3f}",
        f"{trial.rotation_deg:.3f}",
        f"{100 * trial.missing:.0f}",
        f"{100 * trial.wrong:.0f}",
        f"{100 * trial.flagged:.0f}",
        f"{100 * trial.covered:.0f} %",
        f"{trial.first_ref:.1f}",
        f"{trial.later_ref:.1f}",
    )


def _markdown(rows: list[tuple[str, ...]]) -> str:
    lines = [HEAD, tuple("---" if i < 2 else "---:" for i in range(len(HEAD))), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _footer() -> str:
    listed = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"\nWith {listed}; {platform.machine()}, {platform.system()}.\n"


if __name__ == "__main__":
    main()

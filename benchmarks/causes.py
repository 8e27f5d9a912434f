"""Whether the first line of `measure check` names the true cause of a bad recording.

    python -m benchmarks.causes [--only NAME] [--source RECORDING ...] [--strength NAME]
    python -m benchmarks.causes --drawn SEED [--forms] [--only NAME]

Faults are made from recordings that are right: their calibration, body, stamps or pictures are
changed, each fault at up to three strengths; or one of each kind, of drawn amount, of scenes and
rigs that nothing was tuned on; with `--forms` each as a video, grainy, or of two or three cameras,
as drawn. Printed for each is the first cause that is named; at
last how often it is the true one, a wrong one, or none, and how often a right recording is blamed.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.drawn_faults import HZ, SETS, drawn, scenes
from benchmarks.recordings import BESIDE
from benchmarks.rig_faults import CLEAR, GROSS, SLIGHT, Fault, copied, faults, healthy
from measure import api
from measure.checking import Level
from measure.host import Registry
from tests.simulated.sessions import rendered


@dataclass(frozen=True)
class Answer:
    """What was said of one recording."""

    fault: Fault
    recording: str
    words: tuple[str, ...]  # of all causes, the likeliest first
    of: str  # what the first one concerns
    line: str  # the first one, in words

    @property
    def outcome(self) -> str:
        """`right`, `wrong` or `silent`; of a right recording `right` or `alarm`."""
        if not self.fault.causes:
            return "alarm" if self.words else "right"
        if not self.words:
            return "silent"
        right = self.words[0] in self.fault.causes and self.fault.of in self.of
        named = {*self.words}
        right &= all(named & {*either.split(" or ")} for either in self.fault.also)
        return "right" if right else "wrong"


def answers(source: Path, some: list[Fault]) -> Iterator[Answer]:
    """Make each fault, and ask."""
    registry = Registry.discover()
    for fault in some:
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / source.name
            copied(source, copy)
            fault.change(copy)
            yield _answer(fault, source.name, copy, registry)


def _answer(fault: Fault, recording: str, folder: Path, registry: Registry) -> Answer:
    try:
        found = api.check(folder, registry)
    except Exception as problem:
        traceback.print_exc()
        return Answer(fault, recording, ("failed",), "", str(problem))
    causes = [c for c in getattr(found, "causes", ()) if c.level is not Level.NOTE]
    lines = [str(f) for f in found.findings if f.level is Level.WRONG]
    words = tuple(str(c.cause) for c in causes)
    of = causes[0].of if causes else ""
    return Answer(fault, recording, words, of, " / ".join(lines[:2]))


def summary(given: list[Answer]) -> str:
    """The table by cause and strength, and the false alarms: right, wrong and silent of all."""
    rows = [f"| cause | {SLIGHT} | {CLEAR} | {GROSS} |", "| --- | --- | --- | --- |"]
    wrong = [a for a in given if a.fault.causes]
    causes = list(dict.fromkeys(a.fault.causes[0] for a in wrong))
    for cause in (*causes, "all"):
        own = [a for a in wrong if cause in ("all", a.fault.causes[0])]
        rows.append(f"| {cause} | {' | '.join(_counts(own, s) for s in (SLIGHT, CLEAR, GROSS))} |")
    right = [a.outcome for a in given if not a.fault.causes]
    rows.append(f"\nFalse alarms: {right.count('alarm')} of {len(right)} right recordings.")
    return "\n".join(rows)


def _counts(given: list[Answer], strength: str) -> str:
    own = [a.outcome for a in given if a.fault.strength == strength]
    return " / ".join(str(own.count(word)) for word in ("right", "wrong", "silent")) if own else ""


def _made(options: argparse.Namespace) -> Iterator[tuple[Path, list[Fault]]]:
    chosen = list(healthy()) if options.healthy else [*faults(), *healthy()]
    if options.strength:
        chosen = [f for f in chosen if f.strength == options.strength]
    return ((source, chosen) for source in options.source)


def _drawn(seed: int, forms: bool) -> Iterator[tuple[Path, list[Fault]]]:
    for scene in scenes():
        source = rendered(scene, np.arange(SETS) / HZ)
        yield source, list(drawn(source, seed, forms))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.causes", description=__doc__)
    parser.add_argument("--only", default="", help="faults whose name matches this")
    parser.add_argument("--source", type=Path, nargs="+", default=[BESIDE / "still"])
    parser.add_argument("--healthy", action="store_true", help="right recordings alone")
    parser.add_argument("--strength", choices=(SLIGHT, CLEAR, GROSS), help="faults of it alone")
    parser.add_argument("--drawn", type=int, metavar="SEED", help="faults drawn with this")
    parser.add_argument("--forms", action="store_true", help="and drawn forms of the recordings")
    options = parser.parse_args()
    given = []
    for source, some in _drawn(options.drawn, options.forms) if options.drawn else _made(options):
        for answer in answers(source, [f for f in some if re.search(options.only, f.name)]):
            given.append(answer)
            where = f"{answer.recording} {answer.fault.name} ({answer.fault.strength})"
            said = ", ".join(answer.words[:3]) + (f" of {answer.of}" if answer.of else "")
            print(f"{answer.outcome:7}{where:44}{said:40}{answer.line[:170]}", flush=True)
    print(summary(given))


if __name__ == "__main__":
    run_command(main)

"""What a first run compiles, and what that and starting cost.

    python -m benchmarks.first_run SESSION [--checkout FOLDER]

measures a session twice, with an empty cache of compiled code and with the one that leaves. The
difference of the two is what compiling takes. Before that it times the command's help and what a
run imports, the least of five.
"""

from __future__ import annotations

import argparse
import re
import resource
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.command import run_measure, run_python


class Cost(NamedTuple):
    """Of one run.

    Attributes:
        cpu_s: processor time of all its processes.
        wall_s: from its start to its end.
    """

    cpu_s: float
    wall_s: float


def main() -> None:
    """Print lines of code, kernels, compiled overloads, and seconds."""
    parser = argparse.ArgumentParser(prog="benchmarks.first_run", description=__doc__)
    parser.add_argument("session", type=Path, help="a recording")
    parser.add_argument("--checkout", type=Path, default=Path(), help="whose code to run")
    given = parser.parse_args()
    sources = [path.read_text(encoding="utf-8") for path in source_files(given.checkout)]
    print(f"files                {len(sources)}")
    print(f"lines                {sum(text.count(chr(10)) for text in sources)}")
    print(f"kernels              {sum(map(kernels, sources))}")
    helped = started(given.checkout, "from measure.cli import main; main()")
    print(f"CPU s of --help      {helped:.2f}")
    print(f"CPU s of imports     {started(given.checkout, 'from measure.api import run'):.2f}")
    with tempfile.TemporaryDirectory() as cache:
        first, second = (run(given.session, given.checkout, Path(cache)) for _ in range(2))
        overloads = sum(1 for _ in Path(cache).rglob("*.nbc"))
    print(f"overloads            {overloads}")
    print(f"CPU s to compile     {first.cpu_s - second.cpu_s:.0f}")
    print(f"wall s to compile    {first.wall_s - second.wall_s:.0f}")


def source_files(checkout: Path) -> list[Path]:
    """Python files of the program and its built-in plugins."""
    return sorted(
        path for room in ("measure", "plugins") for path in (checkout / room).rglob("*.py")
    )


def kernels(text: str) -> int:
    """Functions of a source file that are compiled."""
    return len(re.findall(r"^@(?:compiled|folded|inlined)\b", text, re.MULTILINE))


def run(session: Path, checkout: Path, cache: Path) -> Cost:
    """Measure a session in a process of its own, with its compiled code in `cache`."""
    with tempfile.TemporaryDirectory() as out:
        arguments = ["run", str(session.resolve()), "-o", str(Path(out, "run")), "--images", "none"]
        before, begun = _cpu_s(), time.monotonic()
        run_measure(checkout, Path(out), *arguments, NUMBA_CACHE_DIR=str(cache))
        return Cost(_cpu_s() - before, time.monotonic() - begun)


def started(checkout: Path, statement: str) -> float:
    """CPU time in s of a Python process with a statement, called as if for help; least of five."""
    took = []
    for _ in range(5):
        before = _cpu_s()
        run_python(checkout, "-c", statement, "--help")
        took.append(_cpu_s() - before)
    return min(took)


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()

"""The fault harness: `python -m benchmarks.faults [PART ...] [--count N] [--seed S]`.

Every part tries so many faults of its kind and tells what came of them; all parts run if none is
named. It takes from minutes to hours: the tests beside it are its quick part.
"""

from __future__ import annotations

import argparse
import importlib
import os

from rich.console import Console
from rich.table import Table

PARTS = ("kills", "cameras", "packets", "soak", "mutations")


def main() -> None:
    """Run the parts, and print one table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--count", type=int, default=50, help="how many faults of each kind")
    parser.add_argument("--seed", type=int, default=1, help="of everything random")
    given = parser.parse_args()
    if unknown := sorted(set(given.parts) - set(PARTS)):
        parser.error(f"no part is called {unknown[0]}; there is {', '.join(PARTS)}")
    if given.count < 1:
        parser.error(f"--count {given.count}: expected a positive number")
    table = Table("part", "tried", "what came out")
    for name in given.parts or PARTS:
        part = importlib.import_module(f"benchmarks.faults.{name}")
        for tried, came_out in part.rows(given.count, given.seed):
            table.add_row(name, tried, came_out)
    Console(width=None if os.isatty(1) else 160).print(table)


if __name__ == "__main__":
    main()

"""Are the results of two checkouts the same to the byte?

    python -m benchmarks.compare_checkouts BEFORE AFTER RENDERS

measures every session under RENDERS with the code of both, calibrates every capture there, and
compares poses.csv and calibration.toml (but for what its provenance says of versions and times).
Moving and renaming code must not change them.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.command import run_measure


def main() -> None:
    """Print a line for each session and capture.

    Raises:
        SystemExit: a result differs.
    """
    parser = argparse.ArgumentParser(prog="benchmarks.compare_checkouts", description=__doc__)
    parser.add_argument("before", type=Path, help="folder of a checkout")
    parser.add_argument("after", type=Path, help="folder of another")
    parser.add_argument("renders", type=Path, help="folder of sessions and captures")
    given = parser.parse_args()
    differing = 0
    with tempfile.TemporaryDirectory() as scratch:
        for source in sorted(path for path in given.renders.iterdir() if path.is_dir()):
            folder = source.resolve()
            before = results(given.before, folder, Path(scratch, "before", source.name))
            after = results(given.after, folder, Path(scratch, "after", source.name))
            differing += before != after
            print(f"{source.name:16}{'same' if before == after else 'DIFFERS'}", flush=True)
    if differing:
        raise SystemExit(1)


def results(checkout: Path, source: Path, out: Path) -> str:
    """What the code of a checkout makes of a session (poses.csv) or a capture (calibration)."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if (source / "capture.toml").exists():
        run_measure(checkout, out.parent, "calibrate", str(source), "-o", str(out))
        return _without_provenance(out.read_text(encoding="utf-8"))
    run_measure(checkout, out.parent, "run", str(source), "-o", str(out), "--images", "none")
    return (out / "poses.csv").read_text(encoding="utf-8")


def _without_provenance(calibration: str) -> str:
    """A calibration file up to the table of versions, times and paths at its end."""
    return calibration.partition("\n[provenance]")[0]


if __name__ == "__main__":
    main()

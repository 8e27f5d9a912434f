"""How many recordings a cluster measures a minute: `python -m benchmarks.cluster SESSION`.

A session is lengthened, forth and back, to `--frames` frame sets, and `--recordings` copies of it
are measured on a dask cluster of this machine with 1, 2, 4 workers of one thread each, every worker
a process. Printed for each: wall time from the first recording's start to the last one's end,
recordings a minute, their ratio to one worker's, and whether all poses are those of `measure run`
alone, to the byte. The workers have compiled the hot loops before the clock starts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.command import run_command
from benchmarks.tables import markdown
from benchmarks.tracking_timing import long_session
from measure.api import RunOptions, Workers, load_profile, run, run_many
from measure.host import Registry

HEAD = ("workers", "wall s", "recordings a minute", "x one worker", "poses the same")


def rows(sessions: Sequence[Path], workers: Sequence[int], out: Path) -> Iterator[tuple[str, ...]]:
    """A row for each number of workers."""
    from distributed import LocalCluster

    profile, registry = load_profile("precise"), Registry.discover()
    options = RunOptions(images="none")
    run(sessions[0], out / "alone", profile, registry, options)
    alone = (out / "alone" / "poses.csv").read_bytes()
    first = 0.0
    for count in workers:
        with LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None) as cluster:
            address = cluster.scheduler_address

            def measured(which: Sequence[Path], name: str, address: str = address) -> list[Path]:
                done = run_many(
                    which, out / name, profile, registry, options, Workers(cluster=address)
                )
                return [one.run for one in done if one.summary]

            measured(sessions[:count], f"warm{count}")
            start = time.perf_counter()
            runs = measured(sessions, f"of{count}")
            wall_s = time.perf_counter() - start
        same = sum((one / "poses.csv").read_bytes() == alone for one in runs)
        pace = 60 * len(runs) / wall_s
        first = first or pace
        share = f"{same} of {len(sessions)}"
        yield str(count), f"{wall_s:.1f}", f"{pace:.1f}", f"{pace / first:.2f}", share


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.cluster", description=__doc__)
    parser.add_argument("session", type=Path, help="a session of JPEG files in one folder")
    parser.add_argument("--recordings", type=int, default=8)
    parser.add_argument("--frames", type=int, default=120, help="frame sets of each recording")
    parser.add_argument("--workers", type=int, nargs="+", default=(1, 2, 4))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        sessions = [Path(scratch) / f"recording{k}" for k in range(given.recordings)]
        for one in sessions:
            long_session(given.session, one, given.frames)
        print(markdown(HEAD, [*rows(sessions, given.workers, Path(scratch) / "runs")]))


if __name__ == "__main__":
    run_command(main)

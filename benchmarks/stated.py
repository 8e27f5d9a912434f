"""Whether poses err as much as their covariances state, recording by recording.

    python -m benchmarks.stated [--only TEXT] [--frames N] [--own]

Measures the recordings beside the repository, and with `--own` the rendered scenes of the tests.
Calibrations and body files are exact, so that light, paint and noise are left. For each the RMS
error of position and rotation, the mean normalised squared error (NEES, 1 is right; above 1 the
covariance is too small) and the share of poses in their 95 % region; at last the means.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from benchmarks.command import run_command
from benchmarks.errors import rms, truth_of
from benchmarks.recordings import recordings_beside, render_all, rendered_scenes
from measure import api
from measure.arrays import Floats
from measure.host import Registry
from measure.results import read_run
from measure.results.pose_table import poses_of
from measure.results.statistics import consistency
from measure.session import open_session


def stated(session: Path, registry: Registry) -> Floats:
    """RMS error (mm, then deg), NEES, and share in the 95 % region: (2, 3)."""
    with tempfile.TemporaryDirectory() as folder:
        api.run(session, Path(folder) / "run", api.load_profile(), registry)
        poses = poses_of(read_run(Path(folder) / "run"))
    off = poses.world_from_body.difference(truth_of(session).at(poses.times_s))
    rows = []
    for part, unit in ((slice(0, 3), 1.0), (slice(3, 6), np.degrees(1.0))):
        found = consistency(off[:, part], poses.covariances[:, part, part])
        assert found is not None
        rows.append((rms(off[:, part]) * unit, found.normalised_squared_error, found.inside_95))
    return np.array(rows)


HEAD = ("recording", "position mm", "NEES", "in 95 %", "rotation deg", "NEES", "in 95 %")


def stated_rows(paths: Mapping[str, Path]) -> Iterator[tuple[str, ...]]:
    """The cells of each recording of one body, then those of the means."""
    registry, found = Registry.discover(), dict[str, Floats]()
    for name, path in paths.items():
        with open_session(path) as session:
            if session.other_bodies:
                continue
        found[name] = stated(path, registry)
        yield name, *_cells(found[name])
    if found:
        yield "mean", *_cells(np.mean(list(found.values()), axis=0))


def _cells(parts: Floats) -> Iterator[str]:
    for error, nees, inside in parts:
        yield from (f"{error:.4f}", f"{nees:.2f}", f"{inside:.0%}")


def main() -> None:
    """Print a row for each recording."""
    parser = argparse.ArgumentParser(prog="benchmarks.stated", description=__doc__)
    parser.add_argument("--only", default="", help="recordings whose name contains this")
    parser.add_argument("--frames", type=int, default=8, help="frame sets of a rendered scene")
    parser.add_argument("--own", action="store_true", help="rendered scenes as well")
    options = parser.parse_args()
    sources = {name: path for name, path in recordings_beside().items() if options.only in name}
    with tempfile.TemporaryDirectory() as folder:
        if options.own:
            scenes = {n: scene for n, scene in rendered_scenes().items() if options.only in n}
            sources |= render_all(scenes, Path(folder), options.frames)
        for row in (HEAD, *stated_rows(sources)):
            print(f"{row[0]:28}" + "".join(f"{cell:>13}" for cell in row[1:]), flush=True)


if __name__ == "__main__":
    run_command(main)

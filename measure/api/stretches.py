"""A long recording, measured in stretches by several processes or a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np

from measure.api.measuring import measure_bodies
from measure.api.run import RunOptions, opened_run, run
from measure.api.spreading import ALL_CORES, Workers, spread
from measure.api.warming_up import warm_pipeline
from measure.errors import MeasureError, RunError
from measure.host import Registry
from measure.measuring import Profile
from measure.processes import Progress, quiet
from measure.results import Summary
from measure.results.tables import Rows, frame_set_rows

LEAST_FRAME_SETS = 900
"""Of a stretch: its burn-in and run-up are some 150 to 200."""
_A_WORKER = 2  # Stretches: the slowest worker holds up the others by half of its share at most


def run_in_stretches(
    session_path: Path,
    out: Path,
    profile: Profile,
    registry: Registry,
    options: RunOptions | None = None,
    workers: Workers = ALL_CORES,
    progress: Progress = quiet,
    on_note: Callable[[str], None] = lambda _: None,
) -> Summary:
    """`run`, with stretches of the recording measured side by side.

    Each stretch begins as a run that is resumed there: poses are those of an undisturbed run to
    within a small part of their error. Its recording for the viewer has no pictures.

    Raises:
        MeasureError: as `run`; and if workers are killed again and again. What was measured before
            it is kept.
    """
    options = options or RunOptions()
    if options.keep_calibration != "off":
        on_note("stretches are measured side by side: a camera that is moved is not followed")
    with opened_run(session_path, out, profile, registry, options, on_note) as (session, writer):
        total = len(session.pair().times_s)
        # Compiled once, and what does not fit together is met before a folder is made.
        warm_pipeline(profile, registry, session.body, session.cameras)
        ends = np.linspace(writer.kept, total, _count(total - writer.kept, workers) + 1, dtype=int)
        stretches = [
            _Stretch(session_path.resolve(), profile, registry, options, start, stop)
            for start, stop in pairwise(ends.tolist())
        ]
        for stretch, rows in zip(stretches, _in_order(stretches, workers), strict=False):
            writer.append_rows(rows, stretch.stop - stretch.start)
            progress(stretch.stop, total)
    # What is left to do: the summary and the recording; and all that no stretch could measure.
    rest = replace(options, resume=True, overwrite=False)
    return run(session_path, out, profile, registry, rest, progress)


def _count(frame_sets: int, workers: Workers) -> int:
    """How many stretches there are of so many frame sets."""
    return max(1, min(_A_WORKER * workers.available(), frame_sets // LEAST_FRAME_SETS))


def _in_order(stretches: Sequence[_Stretch], workers: Workers) -> Iterator[Rows]:
    """The rows of each stretch, up to the first in which something is wrong with the session."""
    measured: dict[int, Rows | None] = {}
    turn = 0
    for number, rows in spread(stretches, workers):
        if isinstance(rows, str):
            raise RunError(f"frame sets {stretches[number].start} and on: {rows}")
        measured[number] = rows
        while turn in measured:
            if (due := measured.pop(turn)) is None:
                return
            yield due
            turn += 1


@dataclass(frozen=True)
class _Stretch:
    """Frame sets from `start` to before `stop`, as they travel to a worker."""

    session: Path
    profile: Profile
    registry: Registry
    options: RunOptions
    start: int
    stop: int

    def __call__(self) -> Rows | None:
        """Measure them; their rows by table, or None if something is wrong with the session."""
        try:
            return self._rows()
        except MeasureError:
            return None

    def _rows(self) -> Rows:
        rows: Rows = {}
        with self.options.open(self.session) as session:
            measured = measure_bodies(session, self.profile, self.registry, self.start)
            for _, measurements in takewhile(lambda one: one[0].index < self.stop, measured):
                some = frame_set_rows(
                    session.bodies, measurements, session.reference, session.cameras
                )
                for name, new in some.items():
                    rows.setdefault(name, []).extend(new)
        return rows

"""Writing a run: one row after the other, safe against a kill, resumable."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from measure.errors import RunError
from measure.measuring import Measurement
from measure.measuring.kept_rig import CameraChange
from measure.model import Body, Camera
from measure.results.folder import FolderLock, check_run_folder, clear, own_files, refuse_folder
from measure.results.journal import (
    GrowingFile,
    Journal,
    finish,
    read_table,
    replacing,
    unfinished,
    writing,
)
from measure.results.provenance import Provenance, read_provenance
from measure.results.rig_changes import CHANGES, change_values, changes_of
from measure.results.run import Run, runs_of
from measure.results.stored import read_tables, refuse_other_run
from measure.results.summary import Summary, together
from measure.results.tables import (
    RELATIVE_COLUMNS,
    Rows,
    csv_columns,
    csv_heading,
    csv_line,
    csv_lines,
    frame_set_rows,
    schemas,
)
from measure.session import Calibration, dump_toml, write_bodies, write_body, write_calibration

FLUSH_EVERY_S = 0.5  # How much of the work a kill may cost; `poses.csv` loses nothing


class RunWriter:
    """A run folder being written; use it as a context manager.

    Whatever cannot be is refused when it is built. Entering it keeps other writers out. `begin`, or
    the first row, begins the run: only then are files written, and those of an earlier run thrown
    away. A run that is resumed keeps its rows; what is appended then are those that follow.

    Args:
        folder: new, empty, or (with `resume` or `overwrite`) an earlier run.
        provenance: what the run is made from.
        bodies: copied into the folder, so that the run can be looked at without its session.
        cameras: in the same order.
        resume: go on with an earlier run of the same.
        overwrite: throw an earlier run away.
        reference: name of the body that the others are written relative to; empty without one.
        clock: seconds, for the rhythm of writing.

    Raises:
        RunError: the folder holds something else, or an earlier run of something else, cannot be
            written, or is being written by another process.
    """

    def __init__(
        self,
        folder: Path,
        provenance: Provenance,
        bodies: Sequence[Body],
        cameras: Sequence[Camera],
        resume: bool = False,
        overwrite: bool = False,
        reference: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._provenance = folder, provenance
        self._bodies, self._cameras = tuple(bodies), tuple(cameras)
        self._reference = reference
        several, relative = len(self._bodies) > 1, bool(reference)
        self._schemas = schemas(several, relative)
        self._columns = {"poses": csv_columns(several)}
        self._columns |= {"relative": RELATIVE_COLUMNS} if relative else {}
        self._resume, self._overwrite, self._clock = resume, overwrite, clock
        # Not `schema.empty_table()`, which loads pandas: that can wait until a row is written.
        self._tables = {n: pa.Table.from_batches([], one) for n, one in self._schemas.items()}
        self.kept = self._frame_sets = 0
        self.camera_changes: tuple[CameraChange, ...] = ()  # that hold for the frame sets so far
        self._lock: FolderLock | None = None
        self._files = ExitStack()
        self._begun = False
        self._flushed_s = clock()
        check_run_folder(folder, resume, overwrite)
        if self._goes_on():
            refuse_other_run(folder, provenance)

    @property
    def kept_runs(self) -> list[Run]:
        """What is kept of an earlier run, of each body, until `begin`."""
        return self._runs(self._tables, finished=False)

    def __enter__(self) -> Self:
        with writing(self._folder):
            if self._folder.exists():
                self._lock_folder(self._resume)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with writing(self._folder):
                self._flush()
        except RunError:
            # Report the failure that ended the block, if there was one.
            if kind is None:
                raise
        finally:
            self._files.close()
            if self._lock is not None:
                self._lock.release()

    def begin(self) -> None:
        """Throw an earlier run away unless it goes on, and write what stands beside the tables."""
        if self._begun:
            return
        with writing(self._folder):
            if self._lock is None:
                self._folder.mkdir(parents=True, exist_ok=True)
                self._lock_folder(resume=False)  # another process may have begun one since
            if not self._goes_on():
                clear(self._folder)
                with replacing(self._folder / "run.toml") as file:
                    file.write_text(dump_toml(self._provenance.values()), "utf-8")
            elif CHANGES in read_provenance(self._folder / "run.toml"):
                self._write_changes(self.camera_changes)  # without those of rows that were lost
            self._write_copies()
            self._open_files()
            # Only now: of a run that was only begun tables may be missing.
            (self._folder / "summary.json").unlink(missing_ok=True)
            self._begun = True

    def append(self, *measured: Measurement) -> None:
        """Write a frame set's measurements, one of each body; it must be the next.

        RunError: it cannot be written (disk full), what was written before is kept.
        """
        rig = measured[0].rig
        if rig is not None and len(rig.changes) != len(self.camera_changes):
            self.begin()
            self._write_changes(rig.changes)
        self.append_rows(frame_set_rows(self._bodies, measured, self._reference, self._cameras), 1)

    def _write_changes(self, changes: tuple[CameraChange, ...]) -> None:
        """Write down where cameras stand from now on."""
        self.camera_changes = changes
        with writing(self._folder):
            values = read_provenance(self._folder / "run.toml")
            with replacing(self._folder / "run.toml") as file:
                file.write_text(dump_toml(values | change_values(changes)), "utf-8")

    def append_rows(self, rows: Rows, frame_sets: int) -> None:
        """The same of the rows of some frame sets, from `frame_set_rows`."""
        self.begin()
        with writing(self._folder):
            for name, journal in self._journals.items():
                journal.add(rows[name])
            for name, file in self._csv.items():
                file.append(b"".join(csv_line(row, self._columns[name]) for row in rows[name]))
            self._frame_sets += frame_sets
            if self._clock() - self._flushed_s >= FLUSH_EVERY_S:
                self._flush()

    def finish(self) -> Summary:
        """Turn the streams into Parquet and write `summary.json`."""
        self.begin()
        with writing(self._folder):
            self._flush()
            self._files.close()
            self._begun = False
            tables = {n: read_table(self._folder, n, s) for n, s in self._schemas.items()}
            summary = self._summary(tables)
            text = json.dumps(summary.values(), indent=2, allow_nan=False, ensure_ascii=False)
            # From here on the run counts as complete.
            with replacing(self._folder / "summary.json") as file:
                file.write_text(text + "\n", "utf-8")
            for name, table in tables.items():
                finish(self._folder, name, table)
        return summary

    def _summary(self, tables: dict[str, pa.Table]) -> Summary:
        runs = self._runs(tables, finished=True)
        if len(runs) == 1:
            return runs[0].summary
        return together({run.body.name: run.summary for run in runs}, tables["poses"])

    def _runs(self, tables: dict[str, pa.Table], finished: bool) -> list[Run]:
        made_from = self._provenance.values() | change_values(self.camera_changes)
        return runs_of(made_from, self._bodies, self._folder, self._cameras, tables, finished)

    def _goes_on(self) -> bool:
        """Whether there is a run to go on with."""
        return self._resume and (self._folder / "run.toml").exists()

    def _lock_folder(self, resume: bool) -> None:
        """Keep other writers out, then look at what there is."""
        self._lock = FolderLock(self._folder)
        try:
            refuse_folder(self._folder, resume, self._overwrite)
            for file in own_files(self._folder):
                unfinished(file).unlink(missing_ok=True)
            if self._goes_on():
                self._tables = read_tables(
                    self._folder,
                    self._bodies,
                    self._cameras,
                    begun_only=not (self._folder / "summary.json").exists(),
                    relative=bool(self._reference),
                )
                rows = self._tables["poses"].num_rows
                self.kept = self._frame_sets = rows // len(self._bodies)
                changes = changes_of(read_provenance(self._folder / "run.toml"))
                self.camera_changes = tuple(c for c in changes if c.frame_set < self.kept)
        except BaseException:
            self._lock.release()
            raise

    def _write_copies(self) -> None:
        if len(self._bodies) == 1:
            with replacing(self._folder / "body.toml") as file:
                write_body(file, self._bodies[0])
        else:
            with replacing(self._folder / "bodies.toml") as file:
                write_bodies(file, self._bodies)
        with replacing(self._folder / "calibration.toml") as file:
            write_calibration(file, Calibration(self._cameras, scale_sd=self._provenance.scale_sd))

    def _open_files(self) -> None:
        kept, self._tables = self._tables, {}
        self._journals: dict[str, Journal] = {}
        for name, table in kept.items():
            journal = Journal(self._folder / f"{name}.arrows", table, self.kept)
            self._files.callback(journal.close)
            self._journals[name] = journal
        self._csv = dict[str, GrowingFile]()
        for name, columns in self._columns.items():
            start = b"".join([csv_heading(columns), *csv_lines(kept[name], columns)])
            self._csv[name] = file = GrowingFile(self._folder / f"{name}.csv", start)
            self._files.callback(file.close)

    def _flush(self) -> None:
        if self._begun:
            for journal in self._journals.values():
                journal.flush(self._frame_sets)
            self._flushed_s = self._clock()

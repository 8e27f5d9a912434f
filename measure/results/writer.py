"""Writing a run: one row after the other, safe against a kill, resumable."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from measure.errors import RunError
from measure.measuring import Measurement
from measure.model import Body, Camera
from measure.results.distances import ball_distances, contradictions
from measure.results.journal import GrowingFile, Journal, finish, read_table, writing
from measure.results.provenance import Provenance, read_provenance
from measure.results.stored import read_tables
from measure.results.summary import Summary, summarise
from measure.results.tables import CSV_COLUMNS, SCHEMAS, csv_line, rows_of
from measure.session import Calibration, dump_toml, write_body, write_calibration

FLUSH_EVERY_S = 0.5
"""How much of the work a kill may cost; `poses.csv` loses nothing."""

_OWN_FILES = ("run.toml", "poses.csv", "summary.json", "run.rrd", "report.html", "body.toml")


class RunWriter:
    """A run folder being written; use it as a context manager.

    Whatever cannot be is refused when it is built. Entering it begins the run: only then are files
    written, and those of an earlier run thrown away.

    Args:
        folder: new, empty, or (with `resume` or `overwrite`) an earlier run.
        provenance: what the run is made from.
        body: copied into the folder, so that the run can be looked at without its session.
        cameras: likewise.
        resume: go on where an earlier run of the same ended.
        overwrite: throw an earlier run away.
        clock: seconds, for the rhythm of writing.

    Raises:
        RunError: the folder holds something else, or an earlier run of something else, or cannot
            be written.
    """

    def __init__(
        self,
        folder: Path,
        provenance: Provenance,
        body: Body,
        cameras: Sequence[Camera],
        resume: bool = False,
        overwrite: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._provenance = folder, provenance
        self._body, self._cameras = body, tuple(cameras)
        self._overwrite, self._clock = overwrite, clock
        with writing(folder):
            _refuse(folder, resume, overwrite)
            going_on = resume and _can_go_on(folder, provenance)
            self._kept = read_tables(folder, body, cameras) if going_on else {}
        self.next_index = self._kept["poses"].num_rows if going_on else 0
        self._files = ExitStack()
        self._finished = False

    def __enter__(self) -> Self:
        with writing(self._folder):
            if not self._kept:
                self._begin()
            self._journals = {
                name: Journal(self._folder / f"{name}.arrows", schema, self._kept.get(name))
                for name, schema in SCHEMAS.items()
            }
            self._csv = _open_csv(self._folder / "poses.csv", self._kept.get("poses"))
        self._files.callback(self._csv.close)
        for journal in self._journals.values():
            self._files.callback(journal.close)
        self._flushed_s = self._clock()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if not self._finished:
                with writing(self._folder):
                    self._flush()
        except RunError:
            # Report the failure that ended the block, if there was one.
            if kind is None:
                raise
        finally:
            self._files.close()

    def append(self, measured: Measurement) -> None:
        """Write one measurement, which must be the next.

        Raises:
            RunError: it cannot be written (disk full); what was written before is kept.
        """
        with writing(self._folder):
            rows = rows_of(measured)
            for name, journal in self._journals.items():
                journal.append(rows[name])
            self._csv.append(csv_line(rows["poses"][0]))
            self.next_index += 1
            if self._clock() - self._flushed_s >= FLUSH_EVERY_S:
                self._flush()

    def finish(self) -> Summary:
        """Turn the streams into Parquet and write `summary.json`."""
        with writing(self._folder):
            self._flush()
            self._files.close()
            self._finished = True
            tables = {name: read_table(self._folder, name, s) for name, s in SCHEMAS.items()}
            distances = ball_distances(self._body, tables["balls"], tables["poses"])
            against = contradictions(self._body, distances)
            notes = self._provenance.notes
            summary = summarise(tables["detections"], tables["poses"], notes, against)
            text = json.dumps(summary.values(), indent=2, allow_nan=False, ensure_ascii=False)
            (self._folder / "summary.json").write_text(text + "\n", "utf-8")
            for name, table in tables.items():
                finish(self._folder, name, table)
        return summary

    def _begin(self) -> None:
        """Throw an earlier run away, and write what stands beside the tables."""
        # Another process may have begun one since.
        _refuse(self._folder, resume=False, overwrite=self._overwrite)
        self._folder.mkdir(parents=True, exist_ok=True)
        _clear(self._folder)
        text = dump_toml(self._provenance.values())
        (self._folder / "run.toml").write_text(text, "utf-8")
        write_body(self._folder / "body.toml", self._body)
        write_calibration(self._folder / "calibration.toml", Calibration(self._cameras))

    def _flush(self) -> None:
        # In this order a pose's row never stands without the rows it was made from.
        for name in ("detections", "balls", "poses"):
            self._journals[name].flush()
        self._flushed_s = self._clock()


def _refuse(folder: Path, resume: bool, overwrite: bool) -> None:
    """Refuse a folder in which no run can be written, or not without losing one."""
    if resume and overwrite:
        raise RunError("--resume goes on with a run, --overwrite throws it away: give one of them")
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file: choose a new folder with --out")
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        number = errno.EACCES if there.is_dir() else errno.ENOTDIR
        raise OSError(number, os.strerror(number))
    if not folder.exists() or not any(folder.iterdir()):
        return
    if not (folder / "run.toml").exists():
        raise RunError(f"{folder} holds files but no run: choose a new folder with --out")
    if not (resume or overwrite):
        raise RunError(f"{folder} holds a run already: --resume goes on, --overwrite starts anew")
    _refuse_links(folder)


def _refuse_links(folder: Path) -> None:
    """Refuse to write through a link, which may lead to any file of the user's."""
    for file in (*own_files(folder), *folder.glob("*.new")):
        if file.is_symlink():
            raise RunError(
                f"{file} is a link to {file.readlink()}, and nothing is written through one: "
                "put the file itself in its place, or choose a new folder with --out"
            )


def _can_go_on(folder: Path, provenance: Provenance) -> bool:
    """Whether there is a run to go on with; one of something else is refused."""
    if not (folder / "run.toml").exists():
        return False
    if changed := provenance.differences(read_provenance(folder / "run.toml")):
        raise RunError(
            f"{folder} cannot be resumed: its run was made with other {', '.join(changed)}; "
            "--overwrite starts anew"
        )
    return True


def own_files(folder: Path) -> list[Path]:
    """The files that are a run's own: those that are there, and those that may be."""
    names = [*_OWN_FILES, "calibration.toml"]
    names += [f"{table}.{kind}" for table in SCHEMAS for kind in ("parquet", "arrows")]
    return [*(folder / name for name in names), *folder.glob("run-*.rrd")]


def _clear(folder: Path) -> None:
    """Remove the files of an earlier run and no others."""
    for file in own_files(folder):
        file.unlink(missing_ok=True)


def _open_csv(path: Path, kept: pa.Table | None) -> GrowingFile:
    """`poses.csv` with its heading and, of a resumed run, the rows of the table that is kept."""
    lines = [",".join(CSV_COLUMNS).encode() + b"\n"]
    lines += [csv_line(row) for row in kept.to_pylist()] if kept is not None else []
    fresh = path.with_suffix(".csv.new")
    fresh.write_bytes(b"".join(lines))
    fresh.replace(path)
    return GrowingFile(path, keep=path.stat().st_size)

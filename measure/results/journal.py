"""Tables that survive a kill: Arrow streams that grow by whole batches, Parquet at the end."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from measure.errors import RunError

MEND = "fetch it from where the run was made, or measure anew with --overwrite"
"""What helps where a run's file is damaged or missing."""


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn a failed write into one line that says what is kept."""
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        what = "the disk is full" if full else f"cannot write ({error.strerror or error})"
        begun = os.path.exists(folder / "run.toml")  # noqa: PTH110 -- `Path.exists` raises on EACCES
        then = (
            "everything measured before is kept: mend that and go on with --resume"
            if begun
            else "nothing was begun: mend that, or choose another folder with --out"
        )
        raise RunError(f"{folder}: {what}; {then}") from error


class GrowingFile:
    """A file that only grows, by whole pieces: one that does not fit leaves no trace."""

    def __init__(self, path: Path, keep: int = 0) -> None:
        """Open the file and cut off all but its first `keep` bytes."""
        self._file: Any = path.open("r+b" if path.exists() else "w+b", buffering=0)
        self._file.truncate(keep)
        self._file.seek(keep)

    def append(self, data: bytes) -> None:
        """Hand bytes to the operating system, where a kill of this process no longer matters.

        Raises:
            OSError: they cannot be written; the file is as before.
        """
        start = self._file.tell()
        try:
            done = 0
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(start)
            os.lseek(self._file.fileno(), start, os.SEEK_SET)
            raise

    def close(self) -> None:
        """Close it; closing twice does no harm."""
        self._file.close()


class Journal:
    """One table, appended in batches to an Arrow stream.

    Args:
        path: the stream, `NAME.arrows`.
        schema: of the table.
        kept: rows to begin with (of a run that is resumed).
    """

    def __init__(self, path: Path, schema: pa.Schema, kept: pa.Table | None = None) -> None:
        self._schema = schema
        self._rows: list[dict[str, Any]] = []
        # The kept rows take the old file's place in one step: never are there fewer than before.
        fresh = path.with_suffix(".new")
        out = GrowingFile(fresh)
        try:
            out.append(bytes(schema.serialize()))
            for batch in kept.combine_chunks().to_batches() if kept is not None else ():
                out.append(bytes(batch.serialize()))
        except OSError:
            fresh.unlink(missing_ok=True)
            raise
        finally:
            out.close()
        fresh.replace(path)
        self._file = GrowingFile(path, keep=path.stat().st_size)

    def append(self, rows: Sequence[dict[str, Any]]) -> None:
        """Take rows, which must not change any more; they are written by the next `flush`."""
        self._rows += rows

    def flush(self) -> None:
        """Hand all rows to the operating system, as one batch.

        Raises:
            OSError: they cannot be written; they are kept for another try.
        """
        if self._rows:
            batch = pa.RecordBatch.from_pylist(self._rows, self._schema)
            self._file.append(bytes(batch.serialize()))
            self._rows = []

    def close(self) -> None:
        """Close the file; rows that were not flushed are lost."""
        self._file.close()


def read_table(folder: Path, name: str, schema: pa.Schema) -> pa.Table:
    """A table of a run, finished or not: whole batches of the stream, a torn last one left out.

    Raises:
        RunError: neither the table nor its stream is there, or the file is not what it should be.
    """
    finished, stream = folder / f"{name}.parquet", folder / f"{name}.arrows"
    try:
        if stream.exists():
            return _whole_batches(stream, schema)
        if finished.exists():
            # Not a file of Python's: threads that read it may let go of it after Python has ended,
            # which aborts the process. As bytes, for names need not be UTF-8.
            with pa.OSFile(os.fsencode(finished)) as file:
                _refuse_missing(schema, pq.read_schema(file))
                return pq.read_table(file, schema=schema)
    except (pa.ArrowException, OSError) as error:
        where = stream if stream.exists() else finished
        raise RunError(f"{where}: cannot be read ({error}): {MEND}") from error
    raise RunError(f"{folder} is torn: it has no {name}.parquet: {MEND}")


def _refuse_missing(wanted: pa.Schema, there: pa.Schema) -> None:
    """Columns that are not there would be read as empty ones."""
    if missing := [name for name in wanted.names if name not in there.names]:
        raise pa.ArrowKeyError(f"no column {', '.join(missing)}")


def _whole_batches(path: Path, schema: pa.Schema) -> pa.Table:
    batches = []
    with path.open("rb") as file:
        try:
            for batch in pa.ipc.open_stream(file):
                batches.append(batch)  # noqa: PERF402 - what was read before a torn end counts
        except (pa.ArrowException, OSError, EOFError):
            pass
    table = pa.Table.from_batches(batches, batches[0].schema if batches else schema)
    _refuse_missing(schema, table.schema)
    return table.select(schema.names).cast(schema)


def finish(folder: Path, name: str, table: pa.Table) -> None:
    """Write a table as Parquet in one step, and drop its stream.

    Raises:
        OSError: it cannot be written; the stream is still there.
    """
    fresh = folder / f"{name}.parquet.new"
    try:
        with fresh.open("wb") as out:
            pq.write_table(table, out, compression="zstd")
    except OSError:
        fresh.unlink(missing_ok=True)
        raise
    fresh.replace(folder / f"{name}.parquet")
    (folder / f"{name}.arrows").unlink(missing_ok=True)

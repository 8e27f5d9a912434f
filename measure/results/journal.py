"""Files of a run that come whole or not at all, or only grow; and tables that survive a kill."""

from __future__ import annotations

import errno
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from measure.errors import RunError
from measure.reading import check_ordinary

MEND = "fetch it from where the run was made, or measure anew with --overwrite"
"""What helps where a run's file is damaged or missing."""
_SEAL, _FRAME_SETS = b"crc32", b"frame_sets"
"""What each batch of a stream bears: the CRC-32 of its data, as the schema says too; and how many
frame sets are complete with it. After a power cut a file may end in zeros, which read as rows."""
_SINCE = ("doubts",)  # Columns that runs of version 0.2.0 lack


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


def unfinished(path: Path) -> Path:
    """Where a file is written before it takes its place."""
    return path.with_name(f"{path.name}.new")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a file beside a place, which it takes in one step; if writing fails, not at all."""
    fresh = unfinished(path)
    try:
        yield fresh
        fresh.replace(path)
    except BaseException:
        with suppress(OSError):
            fresh.unlink()
        raise


def write_whole(path: Path, data: bytes) -> None:
    """Write a file in one step, so that also a power cut leaves this one or the one before."""
    with replacing(path) as fresh, fresh.open("wb") as out:
        out.write(data)
        out.flush()
        os.fsync(out.fileno())


class GrowingFile:
    """A file that only grows, by whole pieces: one that does not fit leaves no trace.

    Args:
        path: where it is; what was there before is replaced in one step.
        start: what it begins with.
    """

    def __init__(self, path: Path, start: bytes) -> None:
        self.path = path
        write_whole(path, start)
        self._file: Any = path.open("ab", buffering=0)

    def append(self, data: bytes) -> None:
        """Hand bytes to the operating system; after an OSError the file is as before."""
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


class Journal(GrowingFile):
    """One table, appended in batches to an Arrow stream.

    Args:
        path: the stream, `NAME.arrows`.
        kept: rows that it begins with, those of an earlier run that is resumed.
        frame_sets: how many have all their rows in `kept`.
    """

    def __init__(self, path: Path, kept: pa.Table, frame_sets: int) -> None:
        self._schema = kept.schema.with_metadata({_SEAL: "of each batch"})
        self._rows: list[dict[str, Any]] = []
        self._frame_sets = frame_sets
        sealed = [self._sealed(batch, frame_sets) for batch in kept.combine_chunks().to_batches()]
        super().__init__(path, b"".join([bytes(self._schema.serialize()), *sealed]))

    def add(self, rows: Sequence[dict[str, Any]]) -> None:
        """Take rows, which must not change any more; they are written by the next `flush`."""
        self._rows += rows

    def flush(self, frame_sets: int) -> None:
        """Write all rows as one batch; those not written (OSError) are kept for another try.

        Args:
            frame_sets: how many have all their rows then, be it none.
        """
        if frame_sets > self._frame_sets:
            batch = pa.RecordBatch.from_pylist(self._rows, self._schema)
            self.append(self._sealed(batch, frame_sets))
            self._rows, self._frame_sets = [], frame_sets

    def _sealed(self, batch: pa.RecordBatch, frame_sets: int) -> bytes:
        """The bytes of a batch in the stream."""
        # As it will be read: what was filtered or sliced has other buffers in memory.
        batch = pa.ipc.read_record_batch(batch.serialize(), self._schema)
        out, facts = BytesIO(), {_SEAL: str(_checksum(batch)), _FRAME_SETS: str(frame_sets)}
        with pa.ipc.new_stream(out, self._schema) as stream:
            stream.write_batch(batch, custom_metadata=facts)
            return out.getvalue()[len(self._schema.serialize()) :]


def read_table(folder: Path, name: str, schema: pa.Schema) -> pa.Table:
    """A table of a run, finished or not: whole batches of the stream, a torn end left out.

    RunError: neither the table nor its stream is there, or it is not what it should be.
    """
    return read_begun_table(folder, name, schema)[0]


def read_begun_table(folder: Path, name: str, schema: pa.Schema) -> tuple[pa.Table, int | None]:
    """`read_table`, and how many frame sets have all their rows in it; None where it is not said.

    It is true of the stream of a run that is not finished: its last rows may be lost.
    """
    finished, stream = folder / f"{name}.parquet", folder / f"{name}.arrows"
    where, frame_sets = stream if stream.exists() else finished, None
    if is_missing(folder, name):
        raise RunError(f"{folder} is torn: it has no {name}.parquet: {MEND}")
    try:
        check_ordinary(where, RunError)
        if where == stream:
            table, frame_sets = _whole_batches(where, schema)
        else:
            table = _whole_table(where, schema)
        table.validate(full=True)  # texts that are none, lists longer than what they hold
    except (pa.ArrowException, OSError, RunError) as error:
        if where == stream and not stream.exists():  # it has become a table just now
            return read_begun_table(folder, name, schema)
        if isinstance(error, RunError):
            raise
        raise RunError(f"{where}: cannot be read ({error}): {MEND}") from error
    return table, frame_sets


def is_missing(folder: Path, name: str) -> bool:
    """Whether neither a table nor its stream is there."""
    return not any((folder / f"{name}.{kind}").exists() for kind in ("parquet", "arrows"))


def _whole_table(path: Path, schema: pa.Schema) -> pa.Table:
    # Not a file of Python's: threads that read it may let go of it after Python has ended, which
    # aborts the process. As bytes, for names need not be UTF-8.
    with pa.OSFile(os.fsencode(path)) as file:
        _refuse_missing(schema, pq.read_schema(file))
        return pq.read_table(file, schema=schema)


def _refuse_missing(wanted: pa.Schema, there: pa.Schema) -> None:
    """Columns that are not there would be read as empty ones; some are, of an earlier version."""
    if missing := [name for name in wanted.names if name not in (*there.names, *_SINCE)]:
        raise pa.ArrowKeyError(f"no column {', '.join(missing)}")
    if twice := [name for name in wanted.names if there.names.count(name) > 1]:
        raise pa.ArrowKeyError(f"column {twice[0]} is there twice")


def _whole_batches(path: Path, schema: pa.Schema) -> tuple[pa.Table, int | None]:
    """The rows before the first torn batch, and how many frame sets they hold entirely."""
    batches: list[pa.RecordBatch] = []
    frame_sets: int | None = 0
    # From memory: lengths that are none, in a torn end, would be asked of the file.
    data = pa.BufferReader(path.read_bytes())
    try:
        stream = pa.ipc.open_stream(data)
        if _SEAL not in (stream.schema.metadata or {}):
            frame_sets = None  # of an earlier version
        while True:
            batch, facts = stream.read_next_batch_with_custom_metadata()
            batch.validate(full=True)
            if frame_sets is not None:
                if int(facts[_SEAL]) != _checksum(batch):
                    break
                frame_sets = int(facts[_FRAME_SETS])
            batches.append(batch)
    except (pa.ArrowException, OSError, StopIteration, KeyError, TypeError, ValueError):
        pass  # what was read before a torn end counts
    table = pa.Table.from_batches(batches, batches[0].schema if batches else schema)
    _refuse_missing(schema, table.schema)
    for name in set(schema.names) - set(table.column_names):
        table = table.append_column(name, pa.nulls(len(table), schema.field(name).type))
    return table.select(schema.names).cast(schema), frame_sets


def _checksum(batch: pa.RecordBatch) -> int:
    """Of all numbers and texts of a batch, as they stand in the file."""
    value = 0
    for column in batch.columns:
        for buffer in column.buffers():
            value = value if buffer is None else zlib.crc32(buffer, value)
    return value


def finish(folder: Path, name: str, table: pa.Table) -> None:
    """Write a table as Parquet in one step, and drop its stream, unless that raises OSError."""
    # Of one piece: the bytes must not tell when rows were flushed.
    whole = table.combine_chunks()
    with replacing(folder / f"{name}.parquet") as fresh, fresh.open("wb") as out:
        pq.write_table(whole, out, compression="zstd")
        out.flush()
        os.fsync(out.fileno())  # a power cut must not take the table after the stream
    (folder / f"{name}.arrows").unlink(missing_ok=True)

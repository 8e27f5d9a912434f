"""Tables that survive a kill: Arrow streams appended as the rows come, Parquet at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from measure.errors import RunError


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Turn a failed write into one line that says what is kept."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{folder}: cannot write ({error.strerror or error}); everything measured before is "
            "kept: mend that and go on with --resume"
        ) from error


class Journal:
    """One table, appended in batches to an Arrow stream.

    Args:
        path: the stream, `NAME.arrows`.
        schema: of the table.
        kept: rows to begin with (of a run that is resumed).
    """

    def __init__(self, path: Path, schema: pa.Schema, kept: pa.Table | None = None) -> None:
        self._path = path
        self._schema = schema
        self._rows: list[dict[str, Any]] = []
        fresh = path.with_suffix(".new")
        self._file = fresh.open("wb")
        self._stream = pa.ipc.new_stream(self._file, schema)
        if kept is not None and kept.num_rows:
            self._stream.write_table(kept)
        self._file.flush()
        fresh.replace(path)

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Take rows; they are written by the next `flush`."""
        self._rows += map(dict, rows)

    def flush(self) -> None:
        """Hand all rows to the operating system."""
        if self._rows:
            self._stream.write_batch(pa.RecordBatch.from_pylist(self._rows, self._schema))
            self._rows = []
        self._file.flush()

    def close(self) -> None:
        """End the stream; closing twice does no harm."""
        if self._file.closed:
            return
        try:
            self.flush()
            self._stream.close()
        finally:
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
            return pq.read_table(finished, schema=schema)
    except (pa.ArrowException, OSError) as error:
        raise RunError(f"{finished}: cannot be read: {error}") from error
    raise RunError(f"{folder} is no run: it has no {name}.parquet")


def _whole_batches(path: Path, schema: pa.Schema) -> pa.Table:
    batches = []
    with path.open("rb") as file:
        try:
            for batch in pa.ipc.open_stream(file):
                batches.append(batch)  # noqa: PERF402 - what was read before a torn end counts
        except (pa.ArrowException, OSError, EOFError):
            pass
    return pa.Table.from_batches(batches, schema)


def finish(folder: Path, name: str, table: pa.Table) -> None:
    """Write a table as Parquet in one step, and drop its stream."""
    fresh = folder / f"{name}.parquet.new"
    pq.write_table(table, fresh, compression="zstd")
    fresh.replace(folder / f"{name}.parquet")
    (folder / f"{name}.arrows").unlink(missing_ok=True)

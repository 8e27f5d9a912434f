"""Tables of numbers from Parquet and CSV files, whole or in pieces; errors name column and row."""

from __future__ import annotations

import codecs
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet
from pyarrow import types as kinds

from measure.arrays import Floats
from measure.bags import BAGS
from measure.errors import EstimatorError
from measure.reading import MAX_TEXT_BYTES, check_ordinary, kind_by_content
from measure.tables import MISSING, Dialect, is_number, read_number_table
from measure_learning.robots.headings import lacking

_SNIFFED_BYTES = 1 << 16


class TableColumns:
    """What a table's columns are called."""

    path: Path
    schema: pa.Schema  # names, types and metadata

    def __contains__(self, name: str) -> bool:
        return name in self.schema.names

    def metadata(self, key: bytes) -> str:
        """Metadata of a Parquet file under a key; empty if there is none."""
        return (self.schema.metadata or {}).get(key, b"").decode("utf-8", "replace")

    def require(self, names: Sequence[str]) -> None:
        """Refuse (EstimatorError) a table that lacks one of these columns, or holds it twice."""
        there = self.schema.names
        if missing := [name for name in names if name not in there]:
            raise lacking(str(self.path), missing, len(names), there)
        if twice := [name for name in names if there.count(name) > 1]:
            raise EstimatorError(f"{self.path}: column '{twice[0]}' is there twice")


class Table(TableColumns):
    """A Parquet or CSV file in memory, or a piece of one.

    Attributes:
        first_row: rows of the file before it.
    """

    def __init__(self, path: Path, content: pa.Table, first_row: int = 0) -> None:
        self.path, self.content, self.first_row = path, content, first_row
        self.schema = content.schema

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a file of Parquet or text, whatever its name; EstimatorError if it cannot be."""
        text = kind_of(path) == ".csv"
        with reading(path):
            if text:
                return cls(path, csv.read_csv(path, **_options(_dialect(path))))
            return cls(path, parquet.read_table(path))

    def __len__(self) -> int:
        return int(self.content.num_rows)

    def numbers(self, *names: str) -> Floats:
        """Columns (n, k) as numbers, NaN for empty cells; EstimatorError: missing or no numbers."""
        self.require(names)
        columns = [self._numbers(name) for name in names]
        return np.stack(columns, axis=1) if columns else np.empty((len(self), 0))

    def labels(self, name: str) -> list[Any]:
        """A column (n,) of names; EstimatorError: missing, something else, or with empty cells."""
        self.require((name,))
        column = self.content[name]
        if kinds.is_nested(column.type):
            raise EstimatorError(f"{self.path}: column '{name}' holds {column.type}, not words")
        values = column.to_pylist()
        if None in values:
            row = self.first_row + values.index(None) + 1
            raise EstimatorError(f"{self.path}: column '{name}' is empty in row {row}")
        return values

    def _numbers(self, name: str) -> Floats:
        column = self.content[name]
        if kinds.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        kind = column.type
        if kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind):
            # A stamp in ns has more digits than a float.
            numbers = column.cast(pa.float64(), safe=False).to_numpy()
            return np.asarray(numbers, dtype=np.float64)
        if kinds.is_null(kind):
            return np.full(len(self), np.nan)
        if kinds.is_string(kind) or kinds.is_large_string(kind):
            texts = enumerate(column.to_pylist(), self.first_row + 1)
            row, text = next((item for item in texts if not is_number(item[1])), (1, ""))
            raise EstimatorError(
                f"{self.path}: column '{name}' holds text, {text!r} in row {row}, where numbers "
                "are needed"
            )
        raise EstimatorError(f"{self.path}: column '{name}' holds {kind}, where numbers are needed")


def kind_of(path: Path) -> str:
    """`.parquet`, `.bag`, `.mcap`, `.db3` or `.csv` (any text), by a file's first bytes."""
    check_ordinary(path, EstimatorError)
    if (kind := kind_by_content(path)) is not None:
        if kind != path.suffix and kind in BAGS:
            raise EstimatorError(f"{path}: is a bag: rename it to {path.stem}{kind}")
        return kind
    if path.suffix not in (".parquet", *BAGS):
        return ".csv"
    start, what = _first_bytes(path), "Parquet" if path.suffix == ".parquet" else "a bag"
    why = f"is text that begins {start[:20].decode()!r}" if start.isascii() else "is damaged"
    raise EstimatorError(f"{path}: cannot be read as {what}: it {why if start else 'is empty'}")


def _first_bytes(path: Path) -> bytes:
    with reading(path), path.open("rb") as file:
        return file.read(_SNIFFED_BYTES)


def _dialect(path: Path, separator: str | None = None) -> Dialect:
    start = _first_bytes(path)
    wide = start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = start.decode("utf-16" if wide else "utf-8-sig", "replace")
    return replace(Dialect.of(text, separator), encoding="utf-16" if wide else "utf-8")


def _options(
    dialect: Dialect, convert: dict[str, Any] | None = None, **read: Any
) -> dict[str, Any]:
    """What pyarrow's readers need."""
    given = {"column_names": dialect.names, "skip_rows": dialect.head} if dialect.names else {}
    return {
        "read_options": csv.ReadOptions(encoding=dialect.encoding, **given, **read),
        "parse_options": csv.ParseOptions(delimiter=dialect.separator),
        "convert_options": csv.ConvertOptions(
            decimal_point=dialect.decimal, null_values=sorted(MISSING), **(convert or {})
        ),
    }


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what pyarrow raises of a file into one line, an EstimatorError."""
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise EstimatorError(f"{path}: cannot be read: {reason}") from None


PIECE_ROWS = 1 << 16  # Rows in memory at a time
_BUFFER_BYTES = 1 << 20
_BLOCK_BYTES = 16 << 20


class TableFile(TableColumns):
    """A Parquet or CSV file that is read as often as needed, a piece at a time."""

    def __init__(self, path: Path, schema: pa.Schema, dialect: Dialect | None = None) -> None:
        self.path, self.schema, self._dialect = path, schema, dialect

    @classmethod
    def open(cls, path: Path, delimiter: str | None = None) -> Self:
        """Read names and types of the columns, of Parquet or text; EstimatorError if neither."""
        text = kind_of(path) == ".csv"
        with reading(path):
            if not text:
                return cls(path, parquet.read_schema(path))
            dialect = _dialect(path, delimiter)
            with csv.open_csv(path, **_options(dialect, block_size=_BLOCK_BYTES)) as reader:
                return cls(path, reader.schema, dialect)

    def pieces(self, numbers: Sequence[str], labels: Sequence[str] = ()) -> Iterator[Table]:
        """The rows of some columns, in order; labels name something, of one type in all pieces."""
        names = list(dict.fromkeys((*numbers, *labels)))
        self.require(names)
        if self._dialect is not None:
            batches = self._csv_batches(self._dialect, names, numbers, labels)
        else:
            batches = self._parquet_batches(names)
        row = 0
        for batch in batches:
            for start in range(0, batch.num_rows, PIECE_ROWS):
                piece = pa.Table.from_batches([batch.slice(start, PIECE_ROWS)])
                yield Table(self.path, piece, row)
                row += piece.num_rows

    def _parquet_batches(self, names: Sequence[str]) -> Iterator[pa.RecordBatch]:
        # Else all columns of a group of rows, often a million, are in memory at once.
        small = {"pre_buffer": False, "buffer_size": _BUFFER_BYTES}
        with reading(self.path), parquet.ParquetFile(self.path, **small) as file:
            yield from file.iter_batches(PIECE_ROWS, columns=names, use_threads=False)

    def _csv_batches(
        self, dialect: Dialect, names: Sequence[str], numbers: Sequence[str], labels: Sequence[str]
    ) -> Iterator[pa.RecordBatch]:
        """Types are those of the whole file: its begin may be whole numbers or empty."""
        flags = {name for name in numbers if kinds.is_boolean(self.schema.field(name).type)}
        types = {name: pa.float64() for name in numbers if name not in flags}
        with reading(self.path):
            for name in labels:
                only = _options(dialect, {"include_columns": [name]})
                types[name] = csv.read_csv(self.path, **only).schema.field(0).type
        convert = {"include_columns": list(names), "column_types": types}
        options = _options(dialect, convert, block_size=_BLOCK_BYTES)
        try:
            with csv.open_csv(self.path, **options) as reader:
                yield from reader
        except pa.ArrowInvalid as error:
            if self.path.stat().st_size <= MAX_TEXT_BYTES:  # names the line of the first bad cell
                read_number_table(
                    self.path, tuple(numbers), error=EstimatorError, empty_is_nan=True
                )
            with reading(self.path):
                raise error from None

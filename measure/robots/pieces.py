"""Tables read in pieces, so that files of any length take little memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import pyarrow as pa
from pyarrow import csv, parquet
from pyarrow import types as kinds

from measure.robots.tables import Columns, Dialect, Table, is_number, kind_of, reading

PIECE_ROWS = 1 << 16  # Rows in memory at a time
_BUFFER_BYTES = 1 << 20
_BLOCK_BYTES = 16 << 20


class TableFile(Columns):
    """A Parquet or CSV file that is read as often as needed, a piece at a time."""

    def __init__(self, path: Path, schema: pa.Schema, dialect: Dialect | None = None) -> None:
        self.path, self.schema, self._dialect = path, schema, dialect

    @classmethod
    def open(cls, path: Path, delimiter: str | None = None) -> Self:
        """Read names and types of the columns, of Parquet or text; EstimatorError if neither.

        Args:
            delimiter: between the cells of text; found if absent.
        """
        text = kind_of(path) == ".csv"
        with reading(path):
            if not text:
                return cls(path, parquet.read_schema(path))
            dialect = Dialect.of(path, delimiter)
            with csv.open_csv(path, **dialect.options(block_size=_BLOCK_BYTES)) as reader:
                return cls(path, reader.schema, dialect)

    def pieces(self, numbers: Sequence[str], labels: Sequence[str] = ()) -> Iterator[Table]:
        """The rows of some columns, in order.

        Args:
            labels: columns that name something; of one type in all pieces.

        Raises:
            EstimatorError: a column is missing or there twice, or the file cannot be read.
        """
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
        types = {name: pa.float64() for name in numbers if self._may_be_number(name)}
        with reading(self.path):
            for name in labels:
                only = dialect.options({"include_columns": [name]})
                types[name] = csv.read_csv(self.path, **only).schema.field(0).type
        try:
            yield from self._text(dialect, names, types)
        except pa.ArrowInvalid as error:
            self._refuse_text(dialect, [name for name in numbers if name in types])
            with reading(self.path):
                raise error from None

    def _may_be_number(self, name: str) -> bool:
        kind = self.schema.field(name).type
        return kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_null(kind)

    def _refuse_text(self, dialect: Dialect, names: Sequence[str]) -> None:
        """Name the first cell that is no number."""
        row = 0
        with reading(self.path):
            texts = dict.fromkeys(names, pa.string())
            for batch in self._text(dialect, names, texts, empty=True):
                for name in names:
                    if not all(map(is_number, batch[name].to_pylist())):
                        Table(self.path, pa.Table.from_batches([batch]), row).numbers(name)
                row += batch.num_rows

    def _text(
        self,
        dialect: Dialect,
        names: Sequence[str],
        types: dict[str, pa.DataType],
        *,
        empty: bool = False,
    ) -> Iterator[pa.RecordBatch]:
        convert = {
            "include_columns": list(names),
            "column_types": types,
            "strings_can_be_null": empty,
        }
        with csv.open_csv(self.path, **dialect.options(convert, block_size=_BLOCK_BYTES)) as reader:
            yield from reader

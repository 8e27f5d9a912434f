"""Writing a run: one row after the other, safe against a kill, resumable."""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow as pa
import pyarrow.compute as pc

from measure.errors import RunError
from measure.measuring import Measurement
from measure.model import Body, Camera
from measure.results.journal import Journal, finish, read_table, writing
from measure.results.provenance import Provenance
from measure.results.summary import Summary, summarise
from measure.results.tables import CSV_COLUMNS, SCHEMAS, csv_row, rows_of
from measure.session import Calibration, dump_toml, write_body, write_calibration

FLUSH_EVERY = 10
"""Frame sets that a kill may cost at most."""

_OWN_FILES = ("run.toml", "poses.csv", "summary.json", "run.rrd", "report.html", "body.toml")


class RunWriter:
    """A run folder being written; use it as a context manager.

    Args:
        folder: new, empty, or (with `resume` or `overwrite`) an earlier run.
        provenance: what the run is made from.
        body: copied into the folder, so that the run can be looked at without its session.
        cameras: likewise.
        resume: go on where an earlier run of the same ended.
        overwrite: throw an earlier run away.

    Raises:
        RunError: the folder holds something else, or an earlier run of something else.
    """

    def __init__(
        self,
        folder: Path,
        provenance: Provenance,
        body: Body,
        cameras: Sequence[Camera],
        resume: bool = False,
        overwrite: bool = False,
    ) -> None:
        self._folder = folder
        with writing(folder):
            earlier = _prepare(folder, provenance, resume, overwrite)
            if not earlier:
                (folder / "run.toml").write_text(dump_toml(provenance.values()), "utf-8")
                write_body(folder / "body.toml", body)
                write_calibration(folder / "calibration.toml", Calibration(tuple(cameras)))
            kept = _kept_rows(folder) if earlier else {}
            self._journals = {
                name: Journal(folder / f"{name}.arrows", schema, kept.get(name))
                for name, schema in SCHEMAS.items()
            }
            self._csv = _open_csv(folder / "poses.csv", kept.get("poses"))
        self._files = ExitStack()
        for file in (self._csv, *self._journals.values()):
            self._files.callback(file.close)
        self.next_index = kept["poses"].num_rows if earlier else 0
        self._unflushed = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with writing(self._folder):
            self._files.close()

    def append(self, measured: Measurement) -> None:
        """Write one measurement, which must be the next.

        Raises:
            RunError: it cannot be written (disk full); what was written before is kept.
        """
        with writing(self._folder):
            for name, rows in rows_of(measured).items():
                self._journals[name].append(rows)
            csv.writer(self._csv).writerow(csv_row(measured))
            self._unflushed += 1
            if self._unflushed >= FLUSH_EVERY:
                self._flush()
        self.next_index += 1

    def finish(self) -> Summary:
        """Turn the streams into Parquet and write `summary.json`."""
        with writing(self._folder):
            self._flush()
            for journal in self._journals.values():
                journal.close()
            tables = {name: read_table(self._folder, name, s) for name, s in SCHEMAS.items()}
            summary = summarise(tables["detections"], tables["poses"])
            text = json.dumps(summary.values(), indent=2, allow_nan=False, ensure_ascii=False)
            (self._folder / "summary.json").write_text(text + "\n", "utf-8")
            for name, table in tables.items():
                finish(self._folder, name, table)
        return summary

    def _flush(self) -> None:
        # In this order a pose's row never stands without the rows it was made from.
        for name in ("detections", "balls", "poses"):
            self._journals[name].flush()
        self._csv.flush()
        self._unflushed = 0


def _prepare(folder: Path, provenance: Provenance, resume: bool, overwrite: bool) -> bool:
    """Make the folder ready; True if an earlier run in it goes on."""
    folder.mkdir(parents=True, exist_ok=True)
    if not any(folder.iterdir()):
        return False
    if not (folder / "run.toml").exists():
        raise RunError(f"{folder} holds files but no run: choose a new folder with --out")
    if overwrite:
        for name in (*_OWN_FILES, "calibration.toml"):
            (folder / name).unlink(missing_ok=True)
        for name in SCHEMAS:
            (folder / f"{name}.parquet").unlink(missing_ok=True)
            (folder / f"{name}.arrows").unlink(missing_ok=True)
        return False
    if not resume:
        raise RunError(f"{folder} holds a run already: --resume goes on, --overwrite starts anew")
    written = tomllib.loads((folder / "run.toml").read_text("utf-8"))
    if changed := provenance.differences(written):
        raise RunError(
            f"{folder} cannot be resumed: its run was made with other {', '.join(changed)}; "
            "--overwrite starts anew"
        )
    return True


def _kept_rows(folder: Path) -> dict[str, pa.Table]:
    """The rows of complete frame sets."""
    tables = {name: read_table(folder, name, schema) for name, schema in SCHEMAS.items()}
    complete = tables["poses"].num_rows
    return {name: t.filter(pc.less(t["index"], complete)) for name, t in tables.items()}


def _open_csv(path: Path, kept: pa.Table | None) -> Any:
    """`poses.csv` with its heading and, of a resumed run, the rows that are kept."""
    lines: list[list[str]] = []
    if kept is not None and path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.reader(file))[1 : kept.num_rows + 1]
    out = path.open("w", newline="", encoding="utf-8")
    writer = csv.writer(out)
    writer.writerow(CSV_COLUMNS)
    writer.writerows(lines)
    return out

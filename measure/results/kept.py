"""What is kept of a run that was interrupted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from measure.errors import RunError
from measure.model import Body, Camera
from measure.reading import check_ordinary
from measure.results.provenance import Provenance, changed_versions, read_provenance
from measure.results.stored import read_tables
from measure.results.tables import schemas


@dataclass(frozen=True, eq=False)
class Kept:
    """Rows of an earlier run, with which a resumed one must agree."""

    tables: Mapping[str, pa.Table]  # by name
    csv_rows: int = 0  # of `poses.csv`, which may be ahead of the tables
    # whether the run was complete: all that may be missing is how it is stored.
    closing: bool = False
    blame: str = ""  # why a row might come out otherwise now
    bodies: int = 1  # how many rows of poses a frame set has

    @property
    def frame_sets(self) -> int:
        """How many are kept."""
        return int(self.tables["poses"].num_rows) // self.bodies

    @property
    def csv_frame_sets(self) -> int:
        """How many of `poses.csv`."""
        return self.csv_rows // self.bodies


def nothing_kept(bodies: int, relative: bool) -> Kept:
    """Of a run that begins."""
    tables = {name: schema.empty_table() for name, schema in schemas(bodies > 1, relative).items()}
    return Kept(tables, bodies=bodies)


def read_kept(
    folder: Path,
    provenance: Provenance,
    bodies: Sequence[Body],
    cameras: Sequence[Camera],
    relative: bool = False,
) -> Kept:
    """Read what is kept in a run's folder.

    Args:
        folder: of the run, with its `run.toml`.
        provenance: of the run that goes on with it.
        bodies: that are measured.
        cameras: that see them.
        relative: whether their poses relative to one of them are written.

    Raises:
        RunError: the run is one of something else, or damaged.
    """
    written = refuse_other_run(folder, provenance)
    closing = (folder / "summary.json").exists()
    tables = read_tables(folder, bodies, cameras, not closing, relative)
    changed = ", ".join(changed_versions(written)) or "another processor, or a damaged file"
    return Kept(tables, csv_rows(folder / "poses.csv"), closing, changed, len(bodies))


def refuse_other_run(folder: Path, provenance: Provenance) -> dict[str, object]:
    """The values of a folder's `run.toml`, if its run was made from the same.

    Raises:
        RunError: it was not, or the file is damaged.
    """
    written = read_provenance(folder / "run.toml")
    if changed := provenance.differences(written):
        raise RunError(
            f"{folder} cannot be resumed: its run was made with other {', '.join(changed)}; "
            "--overwrite starts anew"
        )
    return written


def csv_rows(path: Path) -> int:
    """How many whole rows `poses.csv` has; none if it is not there."""
    if not path.exists():
        return 0
    check_ordinary(path, RunError)
    with path.open("rb") as file:
        return max(sum(line.endswith(b"\n") for line in file) - 1, 0)

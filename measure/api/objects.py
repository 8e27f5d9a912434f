"""Cameras, bodies and runs as objects with arrays: what `import measure` offers.

`measure.api` has the same work from folder to folder, with every option of the commands.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pyarrow as pa

from measure import model, neighbours, results
from measure.api.calibrating import calibrate as calibrate_capture
from measure.api.measuring import measure_bodies
from measure.api.profiles import DEFAULT_PROFILE, load_profile
from measure.api.run import made_from
from measure.arrays import Bytes, Floats
from measure.calibration import Verdict
from measure.errors import ConfigError
from measure.host import Registry
from measure.measuring import Measurement
from measure.results import Provenance, RunWriter
from measure.results.run import one_of, runs_of
from measure.results.tables import SCHEMAS, Rows, codes, doubts_of, frame_set_rows, schemas, texts
from measure.session import (
    ArrayStream,
    Calibration,
    Session,
    Stream,
    open_session,
    read_body,
    read_calibration,
    write_body,
    write_calibration,
)

if TYPE_CHECKING:
    import pandas as pd
    from scipy.spatial.transform import Rotation

Pictures = Mapping[str, Sequence[Bytes]]
"""By camera its pictures (h, w, 3), BGR, uint8."""


class Rig(Calibration):
    """Calibrated cameras: their lenses and poses, and how well these are known."""

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a calibration file, of this program or of another.

        Raises:
            CalibrationError: the file cannot be used.
        """
        known = read_calibration(Path(path))
        return cls(known.cameras, known.provenance, known.scale_sd)

    def save(self, path: Path | str) -> None:
        """Write `calibration.toml`."""
        write_calibration(Path(path), self)


class Body(model.Body):
    """Balls on an object: colours, radii and centres in the object's frame."""

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a body file.

        Raises:
            SessionError: the file cannot be used.
        """
        return _as(cls, read_body(Path(path)))

    def save(self, path: Path | str) -> None:
        """Write a body file."""
        write_body(Path(path), self)


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of a body at one instant."""

    time: float  # s, on the cameras' clock
    position: Floats  # (3,) of the body's origin in the world, mm; NaN without a pose
    rotation: Rotation  # world from body; NaN without a pose
    # (6, 6) x y z in mm, rotation vector in rad, in the world; NaN without a pose.
    covariance: Floats
    status: str  # ok, flagged, lost or skipped
    reason: str  # why it is not ok


class Run:
    """The poses of one body in a recording, as arrays.

    Attributes:
        times: (n,) instants, s.
        position: (n, 3) of the body's origin in the world, mm; NaN without a pose.
        rotation: n rotations, world from body (`scipy.spatial.transform.Rotation`); NaN without.
        covariance: (n, 6, 6) x y z in mm, then the rotation vector in rad, along the world's axes;
            NaN without. The world's scale is not in it: see `scale_sd`.
        status: (n,) `ok`, `flagged`, `lost` or `skipped`.
        reason: (n,) why a pose is not `ok`; empty where it is.
        scale_sd: standard deviation of the world's scale.
        body: the body.
        rig: the cameras.
        bodies: the runs of all bodies of the recording, by name.
    """

    def __init__(self, read: Sequence[results.Run], origin: Provenance, which: int = 0) -> None:
        self._read, self._origin = read, origin
        self._run = read[which]

    @classmethod
    def load(cls, folder: Path | str, body: str | None = None) -> Run:
        """Read a run folder; of a run of several bodies, the first or the one that is named.

        Raises:
            RunError: the folder holds no run, or no such body.
        """
        runs = results.read_runs(Path(folder))
        chosen = 0 if body is None else runs.index(one_of(runs, Path(folder), body))
        return cls(runs, Provenance.of(runs[0].provenance), chosen)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        return f"<Run of {self.body.name}: {self._run.summary.sentence()}>"

    @property
    def bodies(self) -> dict[str, Run]:
        """The runs of all bodies of the recording, by name."""
        everyone = enumerate(self._read)
        return {one.body.name: Run(self._read, self._origin, k) for k, one in everyone}

    @property
    def body(self) -> Body:
        """The body."""
        return _as(Body, self._run.body)

    @property
    def rig(self) -> Rig:
        """The cameras."""
        return Rig(self._run.cameras, scale_sd=self.scale_sd)

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the world's scale."""
        return self._run.scale_sd

    @property
    def times(self) -> Floats:
        """Instants (n,), s."""
        return self._run.times_s

    @property
    def position(self) -> Floats:
        """Positions (n, 3) of the body's origin in the world, mm; NaN without a pose."""
        return self._everywhere(self._run.world_from_body.translation)

    @property
    def rotation(self) -> Rotation:
        """Rotations, world from body; NaN without a pose."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(self._everywhere(self._run.world_from_body.rotvec))

    @property
    def covariance(self) -> Floats:
        """Covariances (n, 6, 6) of the poses; NaN without a pose."""
        return self._everywhere(self._run.covariances)

    @property
    def status(self) -> np.ndarray:
        """`ok`, `flagged`, `lost` or `skipped` (n,)."""
        return texts(self._run.poses, "status")

    @property
    def reason(self) -> np.ndarray:
        """Why a pose is not `ok` (n,)."""
        return texts(self._run.poses, "reason")

    def to_pandas(self) -> pd.DataFrame:
        """A row for every frame set, with the columns of `poses.csv`.

        Raises:
            ConfigError: pandas is not installed.
        """
        try:
            table = self._run.poses.to_pandas()
        except ModuleNotFoundError as problem:
            raise ConfigError("to_pandas needs pandas: pip install pandas") from problem
        table["codes"] = [codes(row) for row in doubts_of(self._run.poses)]
        return table.drop(columns=["covariance", "flags", "doubts", "body"], errors="ignore")

    def save(self, folder: Path | str, overwrite: bool = False) -> None:
        """Write a run folder, which `measure view`, `report` and `evaluate` take.

        Raises:
            RunError: the folder holds something else, or cannot be written.
        """
        bodies, cameras = [one.body for one in self._read], self._run.cameras
        with RunWriter(Path(folder), self._origin, bodies, cameras, overwrite=overwrite) as writer:
            writer.append_rows(self._rows(), len(self))
            writer.finish()

    def _rows(self) -> Rows:
        """The rows of all bodies, by table, in order of the frame sets."""
        rows: Rows = {}
        for name in SCHEMAS:
            rows[name] = [
                row | ({"body": one.body.name} if len(self._read) > 1 else {})
                for one in self._read
                for row in getattr(one, name).to_pylist()
            ]
            rows[name].sort(key=lambda row: row["index"])
        return rows

    def _everywhere(self, values: Floats) -> Floats:
        """Values (m, ...) of the frame sets with a pose, as (n, ...) of all."""
        out = np.full((len(self), *values.shape[1:]), np.nan)
        out[self._run.has_pose] = values
        return out


@dataclass(frozen=True)
class CalibratedRig:
    """Cameras that were calibrated, and how good they are."""

    rig: Rig
    verdict: Verdict
    lines: tuple[str, ...]  # what was measured, and what to know about it


def calibrate(capture: Path | str, body: Path | str | None = None) -> CalibratedRig:
    """Calibrate the cameras of a capture folder.

    Args:
        capture: the folder, as `measure capture` writes it.
        body: the body file to judge the calibration with; the three-ball body if omitted.

    Raises:
        CalibrationError: the pictures give no calibration to rely on.
    """
    found = calibrate_capture(capture, body=body)
    known = found.calibration
    rig = Rig(known.cameras, known.provenance, known.scale_sd)
    return CalibratedRig(rig, found.verdict, tuple(found.lines()))


def measure(
    recording: Path | str | Pictures,
    rig: Calibration | None = None,
    body: model.Body | None = None,
    *,
    times: Floats | Mapping[str, Floats] | None = None,
    profile: str = DEFAULT_PROFILE,
) -> Run:
    """Measure a recording.

    Args:
        recording: the folder of a session; or pictures as arrays, by the names of the cameras.
        rig: the cameras; those of the session if omitted.
        body: the body; that of the session if omitted.
        times: of pictures as arrays, the middles of the exposures in s: (n,) of all cameras, or by
            camera.
        profile: `precise`, `paper`, or the path of a profile file.

    Returns:
        The poses. Nothing is written; `Run.save` writes a run folder.

    Raises:
        MeasureError: the recording, the cameras, the body or the profile cannot be used.
    """
    if isinstance(recording, Mapping):
        if rig is None or body is None or times is None:
            raise ConfigError("pictures as arrays need `rig`, `body` and `times`")
        return _measured_arrays(recording, rig, body, times, profile)
    with TemporaryDirectory() as scratch:
        files = _written(Path(scratch), rig, body)
        with open_session(Path(recording), files.get("rig"), files.get("body")) as session:
            runs, origin = _measured(session, profile)
    if rig is not None:
        origin = replace(origin, calibration="")
    return Run(runs, origin)


def stream(
    cameras: Mapping[str, int | str],
    rig: Calibration,
    body: model.Body,
    *,
    profile: str = DEFAULT_PROFILE,
) -> Iterator[Pose]:
    """Measure running cameras: yields poses as they become known, until the loop is left.

    Args:
        cameras: by name a number of this computer's cameras, a device or an address.
        rig: their calibration.
        body: what is measured.
        profile: `precise`, `paper`, or the path of a profile file.

    Raises:
        MeasureError: a camera cannot be reached, or what is given does not fit together.
    """
    measured = neighbours.offer(neighbours.STREAMS, "cameras", "`measure.stream`")
    if measured is None:
        raise neighbours.lacking("`measure.stream`", "measure_studio")
    found = measured(cameras, rig, body, load_profile(profile), Registry.discover())
    yield from map(_pose, found)


def _pose(measured: Measurement) -> Pose:
    from scipy.spatial.transform import Rotation

    pose = measured.pose
    place = None if pose is None else pose.world_from_body
    return Pose(
        measured.time_s,
        np.full(3, np.nan) if place is None else place.translation,
        Rotation.from_rotvec(np.full(3, np.nan) if place is None else place.rotvec),
        np.full((6, 6), np.nan) if pose is None else pose.covariance,
        measured.status,
        measured.reason,
    )


def _measured_arrays(
    pictures: Pictures,
    rig: Calibration,
    body: model.Body,
    times: Floats | Mapping[str, Floats],
    profile: str,
) -> Run:
    if isinstance(times, Mapping) and (missing := [name for name in pictures if name not in times]):
        raise ConfigError(f"`times` lacks camera '{missing[0]}'")
    streams: dict[str, Stream] = {
        name: ArrayStream(name, some, times[name] if isinstance(times, Mapping) else times)
        for name, some in pictures.items()
    }
    cameras = tuple(rig.camera(name) for name in pictures)
    for camera in cameras:
        size, seen = camera.intrinsics.size_wh, streams[camera.name].size_wh
        if size != seen:
            raise ConfigError(
                f"pictures of camera '{camera.name}' are {seen[0]}x{seen[1]} px, and `rig` has it "
                f"calibrated at {size[0]}x{size[1]}"
            )
    with TemporaryDirectory() as scratch:
        file = _written(Path(scratch), rig, None)["rig"]
        session = Session("arrays", Path("arrays"), body, cameras, streams, file)
        runs, origin = _measured(replace(session, scale_sd=rig.scale_sd), profile)
    return Run(runs, replace(origin, session="", calibration=""))


def _written(folder: Path, rig: Calibration | None, body: model.Body | None) -> dict[str, Path]:
    """The files of cameras and body, where they are given."""
    files = {}
    if rig is not None:
        files["rig"] = folder / "calibration.toml"
        write_calibration(files["rig"], rig)
    if body is not None:
        files["body"] = folder / "body.toml"
        write_body(files["body"], body)
    return files


def _measured(session: Session, profile: str) -> tuple[list[results.Run], Provenance]:
    chosen, registry = load_profile(profile), Registry.discover()
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for _, measured in measure_bodies(session, chosen, registry):
        for name, some in frame_set_rows(session.bodies, measured, "", session.cameras).items():
            rows[name] += some
    known = schemas(len(session.bodies) > 1)
    tables = {name: pa.Table.from_pylist(rows[name], schema) for name, schema in known.items()}
    origin = made_from(session, chosen, registry)
    at = Path(session.name)
    return runs_of(origin.values(), session.bodies, at, session.cameras, tables, True), origin


def _as(kind: type[Any], body: model.Body) -> Any:
    """A body of the model as one that can be loaded and saved."""
    names = model.Body.__dataclass_fields__
    return kind(**{name: getattr(body, name) for name in names})

"""A session without its pictures: read to be changed, and written into a folder of its own."""

from __future__ import annotations

import csv
import glob
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.arrays import Floats, Ints
from measure.model import Body, Camera
from measure.session.body_file import write_body
from measure.session.calibration_file import JOINT_COVARIANCE, Calibration
from measure.session.calibrations import read_calibration, write_calibration
from measure.session.files import dump_toml, load_toml
from measure.session.opening import SessionModel
from measure.session.session import Session
from measure.session.streams import AlteredStream, Stream, numbers_in

_CLOCKS = ("clock_digest", "clock_shifts_s")  # Which the stamps contain once they are written


@dataclass(frozen=True, eq=False)
class CameraSource:
    """Where a camera's pictures are, and when they were taken.

    Attributes:
        table: its `[[cameras]]` table, with absolute paths and without name and stamps.
        frames: (n,) numbers of all its pictures, increasing.
        times_s: (n,) their stamps on the session's clock, increasing.
        files: (n,) their names, where these do not end with the numbers.
    """

    name: str
    table: Mapping[str, Any]
    frames: Ints
    times_s: Floats
    files: tuple[str, ...] = ()

    def altered(self, **entries: Any) -> CameraSource:
        """The same with other entries of its table."""
        return replace(self, table={**self.table, **entries})


@dataclass(frozen=True, eq=False)
class SessionParts:
    """What a session is measured with, its pictures by their paths."""

    head: Mapping[str, Any]  # the `[session]` table, with absolute paths
    sources: tuple[CameraSource, ...]
    cameras: tuple[Camera, ...]  # one of each source, in their order
    bodies: tuple[Body, ...]
    provenance: Mapping[str, Any]  # of the calibration
    scale_sd: float
    robot: Mapping[str, Any] | None = None

    @classmethod
    def of(cls, session: Session) -> SessionParts:
        """Of an opened session."""
        given = load_toml(session.path, SessionModel)
        folder, known = session.path.parent.absolute(), read_calibration(session.calibration_path)
        tables = {table.name: table.model_dump(exclude_defaults=True) for table in given.cameras}
        truth, log = session.truth_path, session.robot_log
        head = {
            "name": session.name,
            "description": session.description,
            "truth": str(truth.absolute()) if truth else "",
            "reference": session.reference,
        }
        left_out = (
            _CLOCKS if known.names == tuple(session.streams) else (*_CLOCKS, JOINT_COVARIANCE)
        )
        return cls(
            {key: value for key, value in head.items() if value},
            tuple(
                _source(stream, tables[name], folder) for name, stream in session.streams.items()
            ),
            session.cameras,
            session.bodies,
            {key: value for key, value in known.provenance.items() if key not in left_out},
            session.scale_sd,
            {"log": str(log.absolute())} if log else None,
        )

    def index(self, camera: str) -> int:
        """The place of a camera."""
        return [one.name for one in self.sources].index(camera)

    def with_camera(self, camera: Camera, source: CameraSource | None = None) -> SessionParts:
        """The same with another camera, and source, of that name."""
        at = self.index(camera.name)
        cameras, sources = list(self.cameras), list(self.sources)
        cameras[at] = camera
        sources[at] = source or sources[at]
        return replace(self, cameras=tuple(cameras), sources=tuple(sources))

    def with_body(self, body: Body) -> SessionParts:
        """The same with another (first) body."""
        return replace(self, bodies=(body, *self.bodies[1:]))

    def write(self, folder: Path) -> None:
        """Write `session.toml`, calibration, bodies and stamps into a folder that is there."""
        files = ["body.toml", *(f"body-{k}.toml" for k in range(2, len(self.bodies) + 1))]
        for name, body in zip(files, self.bodies, strict=True):
            write_body(folder / name, body)
        calibration = Calibration(self.cameras, self.provenance, self.scale_sd)
        write_calibration(folder / "calibration.toml", calibration)
        tables = []
        for source in self.sources:
            stamps = f"{source.name}.csv"
            with (folder / stamps).open("w", encoding="utf-8", newline="") as file:
                rows = csv.writer(file, lineterminator="\n")
                rows.writerow(("filename" if source.files else "frame", "time_s"))
                times = (f"{time_s:.9f}" for time_s in source.times_s)
                rows.writerows(zip(source.files or source.frames.tolist(), times, strict=True))
            tables.append({"name": source.name, **source.table, "timestamps": stamps})
        head = {**self.head, "calibration": "calibration.toml"}
        head |= {"body": files[0]} if len(files) == 1 else {"bodies": files}
        values = {"session": head, "cameras": tables, "robot": self.robot}
        (folder / "session.toml").write_text(dump_toml(values), "utf-8")


def _source(stream: Stream, table: Mapping[str, Any], folder: Path) -> CameraSource:
    """A camera of an opened session, with the stamps of all its pictures as they are used."""
    whole, times_s = stream, stream.times_s
    if isinstance(stream, AlteredStream):
        whole = stream.whole
        times_s = whole.times_s + (stream.times_s[0] - whole.times_s[stream.positions[0]])
    kept = {
        key: value
        for key, value in table.items()
        if key not in ("name", "timestamps", "time_column", "time_offset_s")
    }
    if "images" in kept and not Path(kept["images"]).is_absolute():
        kept["images"] = f"{glob.escape(str(folder))}/{kept['images']}"
    if "video" in kept:
        kept["video"] = str(folder / kept["video"])
    numbers, files = numbers_in(whole.files, whole.frames), tuple[str, ...]()
    if "images" in kept and None not in numbers and len(set(numbers)) == len(numbers):
        counted = numbers == whole.frames.tolist()
        files = () if counted else tuple(file.name for file in whole.files)
    return CameraSource(stream.name, kept, whole.frames, np.asarray(times_s), files)

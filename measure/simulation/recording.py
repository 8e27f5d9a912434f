"""Writing a scene as a session folder (docs/files.md), with its exact truth."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from threading import Event

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.processes import Progress
from measure.session import Calibration, dump_toml, write_body, write_calibration
from measure.session.trajectory import COLUMNS
from measure.simulation.renderer import Renderer
from measure.simulation.scene import Scene
from measure.simulation.sensor import encode

TRUTH_HZ = 480.0
_TRUTH_MARGIN_S = 0.05


def write_session(
    scene: Scene,
    times_s: ArrayLike | Mapping[str, ArrayLike],
    folder: str | Path,
    *,
    progress: Progress | None = None,
) -> Path:
    """Render a scene into a session folder, made if missing; gives the folder.

    Pictures of an earlier session in it are removed. The files state `scene.stated_cameras` and
    `scene.stated_body` where those are given. An interrupt ends it after the picture that each
    thread draws.

    Args:
        times_s: (n,) nominal instants, to which every camera adds its phase; or the mid-exposure
            times of each camera by name.
        progress: called with pictures done and in all.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stamps = _camera_times(scene, times_s)
    total, done = sum(len(t) for t in stamps.values()), iter(range(1, 1 << 60))
    pictures = {name: _write_pictures(scene, name, stamps[name], folder) for name in stamps}
    over = Event()

    def record(name: str, most: int | None = None) -> None:
        for _ in islice(pictures[name], most):
            if progress is not None:
                progress(next(done), total)
            if over.is_set():
                return

    for name, times in stamps.items():
        rows = np.column_stack([np.arange(len(times)), times])
        _write_table(folder / f"{name}.csv", ("frame", "time_s"), rows, ("%d", "%.9f"))
    # The first picture compiles what draws, which an interrupt of this thread alone ends.
    record(next(iter(stamps)), 1)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        try:
            list(pool.map(record, stamps))
        except BaseException:
            over.set()
            raise
    _write_descriptions(scene, tuple(stamps), folder)
    every = np.concatenate(list(stamps.values()))
    first, last = every.min() - _TRUTH_MARGIN_S, every.max() + _TRUTH_MARGIN_S
    times = np.arange(np.floor(first * TRUTH_HZ), np.ceil(last * TRUTH_HZ) + 1) / TRUTH_HZ
    write_truth(folder / "truth.csv", times, scene.trajectory.at(times))
    return folder


def _camera_times(scene: Scene, times_s: ArrayLike | Mapping[str, ArrayLike]) -> dict[str, Floats]:
    """Mid-exposure times (n,) of every camera by name."""
    if isinstance(times_s, Mapping):
        return {name: np.asarray(t, dtype=np.float64) for name, t in times_s.items()}
    nominal = np.asarray(times_s, dtype=np.float64)
    return {c.name: nominal + scene.phases_s.get(c.name, 0.0) for c in scene.cameras}


def _write_pictures(scene: Scene, camera: str, times_s: Floats, folder: Path) -> Iterator[None]:
    sensor, renderer = scene.sensor_of(camera), Renderer(scene, camera)
    (folder / camera).mkdir(exist_ok=True)
    for old in (folder / camera).glob(f"[0-9]*.{sensor.encoding}"):
        old.unlink()
    for frame, time_s in enumerate(times_s):
        picture = encode(renderer.picture(float(time_s), frame), sensor)
        (folder / camera / f"{frame:06d}.{sensor.encoding}").write_bytes(picture)
        yield


def _write_descriptions(scene: Scene, names: tuple[str, ...], folder: Path) -> None:
    write_body(folder / "body.toml", scene.stated_body or scene.body)
    stated = Calibration(scene.stated_cameras or scene.cameras)
    write_calibration(folder / "calibration.toml", stated)
    session = {
        "name": scene.name,
        "description": scene.description,
        "body": "body.toml",
        "calibration": "calibration.toml",
        "truth": "truth.csv",
    }
    cameras = [
        {"name": n, "images": f"{n}/*.{scene.sensor_of(n).encoding}", "timestamps": f"{n}.csv"}
        for n in names
    ]
    text = dump_toml({"session": session, "cameras": cameras})
    (folder / "session.toml").write_text(text, encoding="utf-8")


def write_truth(path: Path, times_s: Floats, world_from_body: RigidTransform) -> None:
    """A trajectory, world_from_body at times (n,)."""
    rows = np.column_stack([times_s, world_from_body.translation, world_from_body.quat_wxyz])
    _write_table(path, COLUMNS, rows, ("%.9f", *["%.6f"] * 3, *["%.9f"] * 4))


def _write_table(
    path: Path, names: tuple[str, ...], rows: Floats, formats: tuple[str, ...]
) -> None:
    np.savetxt(path, rows, formats, ",", header=",".join(names), comments="")

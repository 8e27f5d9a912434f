"""Rendered sessions that several test files measure."""

from __future__ import annotations

import fcntl
import hashlib
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import FunctionType

import numpy as np
from numpy.typing import ArrayLike

from measure import geometry, model, simulation
from measure.simulation import Scene, write_session
from tests.simulated.catalogue import scene_catalogue

CACHE = Path(__file__).resolve().parents[2] / ".render_cache"
_ROOMS = [Path(room.__file__ or "").parent for room in (geometry, model, simulation)]
_RENDERERS = (*_ROOMS, Path(__file__).parent)
STILL_SETS, STILL_HZ = 12, 30.0
_KEPT_S = 14 * 86400.0


def rendered(scene: Scene, times_s: ArrayLike) -> Path:
    """The session of a scene, rendered by the first process that asks for it; read-only.

    It is kept for two weeks under a digest of the scene, the times and what renders them.
    """
    sources = (file.read_bytes() for room in _RENDERERS for file in sorted(room.glob("*.py")))
    digest = hashlib.sha256(b"".join([*_parts((scene, np.asarray(times_s, float))), *sources]))
    place = CACHE / digest.hexdigest()[:16]
    place.mkdir(parents=True, exist_ok=True)
    folder = place / scene.name.replace(" ", "-")
    with (place / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            shutil.rmtree(place / "begun", ignore_errors=True)
            write_session(scene, times_s, place / "begun").rename(folder)
            for old in CACHE.iterdir():
                if time.time() - old.stat().st_mtime > _KEPT_S:
                    shutil.rmtree(old, ignore_errors=True)
    return folder


def _parts(value: object) -> Iterator[bytes]:
    """What tells a value from others: arrays, records, and functions with what they close over."""
    if isinstance(value, np.ndarray):
        yield value.tobytes()
    elif isinstance(value, Mapping):
        yield from _parts(tuple(value.items()))
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _parts(part)
    elif is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__.encode()
        yield from _parts(tuple(getattr(value, one.name) for one in fields(value)))
    elif isinstance(value, FunctionType):
        yield value.__qualname__.encode() + value.__code__.co_code
        yield from _parts(tuple(cell.cell_contents for cell in value.__closure__ or ()))
    elif hasattr(value, "__dict__"):
        yield type(value).__name__.encode()
        yield from _parts(tuple(vars(value).items()))
    else:
        yield repr(value).encode()


def still_session() -> Path:
    """The scene `still` at 30 Hz."""
    return rendered(scene_catalogue()["still"], np.arange(STILL_SETS) / STILL_HZ)


def part_of(session: Path, frames: range, folder: Path) -> Path:
    """A session of some frame sets of another, called as its folder."""
    folder.mkdir(parents=True)
    for name in ("body.toml", "calibration.toml", "truth.csv"):
        shutil.copy(session / name, folder)
    text = (session / "session.toml").read_text("utf-8")
    named = re.sub('^name = ".*"$', f'name = "{folder.name}"', text, count=1, flags=re.MULTILINE)
    (folder / "session.toml").write_text(named, "utf-8")
    for stamps in session.glob("cam*.csv"):
        head, *rows = stamps.read_text("utf-8").split()
        times = [row.partition(",")[2] for row in rows[frames.start : frames.stop : frames.step]]
        lines = [head, *(f"{number},{time}" for number, time in enumerate(times))]
        (folder / stamps.name).write_text("\n".join(lines) + "\n", "utf-8")
        (folder / stamps.stem).mkdir()
        pictures = sorted((session / stamps.stem).iterdir())
        for number, picture in enumerate(pictures[frames.start : frames.stop : frames.step]):
            shutil.copy(picture, folder / stamps.stem / f"{number:06d}{picture.suffix}")
    return folder

"""The measured recordings: rendered scenes, and recordings beside the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.altered import ALTERATIONS, RESIZED, altered_copy
from measure.simulation import Scene, write_session
from tests.simulated.catalogue import relit_scenes, scene_catalogue
from tests.simulated.unusual import unusual_scenes

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "renders"
RELIT = "relit "
UNUSUAL = "unusual "
ALTERED = "altered "
"""What the names of recordings of own scenes in other light, of unusual scenes, and of altered
recordings begin with."""


def rendered_scenes() -> dict[str, Scene]:
    """The scenes that are rendered, by the names of their recordings."""
    usual = {f"own {name}": scene for name, scene in scene_catalogue().items()}
    usual |= {RELIT + name: scene for name, scene in relit_scenes().items()}
    return usual | {UNUSUAL + name: scene for name, scene in unusual_scenes().items()}


def render_all(scenes: dict[str, Scene], folder: Path, frames: int) -> dict[str, Path]:
    """Render scenes into `folder`, those that are not there already."""
    times = np.arange(frames) / 30.0
    out = {}
    for name, scene in scenes.items():
        target = folder / f"{name.removeprefix('own ').replace(' ', '-')}-{frames}"
        if not (target / "truth.csv").exists():
            write_session(scene, times, target)
        out[name] = target
    return out


def recordings_beside() -> dict[str, Path]:
    """Sessions with truth in ../shared/renders, if that is there."""
    found = sorted(BESIDE.glob("*/session.toml")) if BESIDE.is_dir() else []
    return {path.parent.name: path.parent for path in found if (path.parent / "truth.csv").exists()}


def altered_recordings() -> dict[str, tuple[Path, str]]:
    """Recordings beside and what alters them, by the names of the altered ones."""
    return {
        f"{ALTERED}{name} {how}": (path, how)
        for name, path in recordings_beside().items()
        for how in (*ALTERATIONS, *RESIZED)
    }


def alter_all(wanted: dict[str, tuple[Path, str]], folder: Path) -> dict[str, Path]:
    """Altered copies in `folder` of recordings, those that are not there already."""
    out = {}
    for name, (path, how) in wanted.items():
        out[name] = folder / name.replace(" ", "-")
        altered_copy(path, out[name], how)
    return out

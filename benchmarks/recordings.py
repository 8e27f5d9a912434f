"""What is measured: the program's own scenes, and recordings that lie beside the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.simulation import Scene, scene_catalogue, unusual_scenes, write_session

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "renders"
UNUSUAL = "unusual "
"""What the names of recordings of unusual scenes begin with."""


def rendered_scenes() -> dict[str, Scene]:
    """The scenes that are rendered, by the names of their recordings."""
    usual = {f"own {name}": scene for name, scene in scene_catalogue().items()}
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

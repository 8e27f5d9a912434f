"""What is measured: the program's own scenes, and recordings that lie beside the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measure.simulation import scene_catalogue, write_session

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "renders"


def own_recordings(folder: Path, frames: int) -> dict[str, Path]:
    """Render the catalogue's scenes, once, into `folder`."""
    times = np.arange(frames) / 30.0
    out = {}
    for name, scene in scene_catalogue().items():
        target = folder / f"{name}-{frames}"
        if not (target / "truth.csv").exists():
            write_session(scene, times, target)
        out[f"own {name}"] = target
    return out


def recordings_beside() -> dict[str, Path]:
    """Sessions with truth in ../shared/renders, if that is there."""
    found = sorted(BESIDE.glob("*/session.toml")) if BESIDE.is_dir() else []
    return {path.parent.name: path.parent for path in found if (path.parent / "truth.csv").exists()}

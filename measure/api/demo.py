"""The demonstration: a rendered session measured against exact truth, and what others add."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from measure.api.outputs import new_folder
from measure.api.results import evaluate
from measure.api.run import RunOptions, run
from measure.api.warming_up import compilation_notice, compile_pipeline
from measure.errors import ConfigError
from measure.host import Registry
from measure.measuring import Profile
from measure.neighbours import DEMO, offers
from measure.processes import Progress, quiet
from measure.results import RunEvaluation, Summary, read_runs
from measure.session import open_session

DEMO_FRAMES = 30
DEMO_RATE_HZ = 30.0
_MARK = "session/session.toml"


@dataclass(frozen=True)
class Addition:
    """What a package beside this one adds to the demonstration: one table."""

    sentence: str  # above it
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float, ...], ...]
    values: dict[str, Any]  # the same for programs


@dataclass(frozen=True)
class Demo:
    """What the demonstration made and found."""

    session: Path
    run: Path
    picture: Path  # the views of one frame set with what was found in them
    summary: Summary
    evaluation: RunEvaluation
    additions: dict[str, Addition]  # by name of their entry points


def demo(
    folder: Path,
    profile: Profile,
    registry: Registry,
    frames: int = DEMO_FRAMES,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> Demo:
    """Render a short session of four cameras, measure it, and compare it with the exact truth.

    Then what packages beside this one add, by entry points of the group `measure.demo`: functions
    without arguments that return an `Addition`. Of an earlier demonstration in the folder
    ConfigError, or with `overwrite` it is replaced.
    """
    from measure.simulation.catalogue import webcam_scene
    from measure.viewing.drawings import write_mosaic

    scene = webcam_scene()
    pictures = frames * len(scene.cameras)
    run_folder, picture = folder / "run", folder / "demo.png"
    options = RunOptions(images=max(frames // 10, 1))
    with new_folder(folder, overwrite, _MARK):
        _check_frames(frames)
        with compilation_notice() as end_notices:
            compile_pipeline(profile, registry, scene.body, scene.cameras)

            def rendered(done: int, _: int | None) -> None:
                end_notices()
                progress(done, pictures + frames)

            session = render_demo(folder, frames, rendered)

        def measured(done: int, _: int | None) -> None:
            progress(pictures + done, pictures + frames)

        summary = run(session, run_folder, profile, registry, options, measured)
        with open_session(session) as opened:
            write_mosaic(opened, read_runs(run_folder), frames // 2, picture)
        additions = {name: demonstrated() for name, demonstrated in offers(DEMO)}
        return Demo(session, run_folder, picture, summary, evaluate(run_folder), additions)


def render_demo(folder: Path, frames: int = DEMO_FRAMES, progress: Progress = quiet) -> Path:
    """Render the demonstration's session, without measuring it; returns the session's folder."""
    from measure.simulation import write_session
    from measure.simulation.catalogue import webcam_scene

    _check_frames(frames)
    scene = replace(webcam_scene(), name="demo", description="rendered by measure demo")
    times = np.arange(frames) / DEMO_RATE_HZ
    return write_session(scene, times, folder / "session", progress=progress)


def _check_frames(frames: int) -> None:
    if frames < 1:
        raise ConfigError(f"{frames} frames: the demonstration needs at least one")

"""The way through: its steps, and which of them are done by what is there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from measure_studio.page.bench import Bench


@dataclass(frozen=True)
class Step:
    """One page of the way, and what says that it is done."""

    path: str
    name: str
    is_done: Callable[[Bench], bool]


def _deliver(bench: Bench) -> bool:
    """Whether there are cameras, and all of them deliver, or are in use."""
    states = [bench.state(name)[0] for name in bench.names]
    return bool(states) and "away" not in states and ("held" not in states or bench.job is not None)


def _is_calibrated(bench: Bench) -> bool:
    return bench.calibration is not None


def _has_world(bench: Bench) -> bool:
    """Whether a board, a body or markers said where the world is, not the first camera alone."""
    notes = bench.calibration.provenance if bench.calibration is not None else {}
    return "world" in notes or notes.get("mark_sd_px") is not None


def _has_body(bench: Bench) -> bool:
    return any(bench.folder.glob("body*.toml"))


def _has_run(bench: Bench) -> bool:
    return any(bench.folder.glob("run-*/report.html"))


STEPS = (
    Step("/", "Cameras", _deliver),
    Step("/calibration", "Calibration", _is_calibrated),
    Step("/world", "World", _has_world),
    Step("/body", "Body", _has_body),
    Step("/measure", "Measure", _has_run),
)
ASIDE = {
    "/marks": ("Marks", "/world"), "/recordings": ("Recordings", "/measure"),
    "/help": ("Help", "/"),
}  # fmt: skip
"""Pages beside the way: their names, and the steps that they belong to."""


def step_of(path: str) -> int:
    """Number of the step that a page belongs to, from 0."""
    return [step.path for step in STEPS].index(ASIDE.get(path, ("", path))[1])

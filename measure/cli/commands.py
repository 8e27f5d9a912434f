"""The table of sub-commands, in the order in which a newcomer meets them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """One sub-command.

    Attributes:
        name: as typed; `measure/cli/NAME.py` holds the function (or cyclopts App) `NAME`.
        summary: its line in `measure --help`, the first line of its docstring.
    """

    name: str
    summary: str


GROUPS: dict[str, tuple[Command, ...]] = {
    "First steps": (
        Command(
            "demo",
            "Render a session, measure it, compare with the truth; correct a simulated robot.",
        ),
    ),
    "Set up": (
        Command("detect", "Show what the detector sees in single pictures."),
        Command("target", "Draw a printable board, marker field or body."),
        Command("record", "Record cameras into a session."),
        Command("calibrate", "Calibrate cameras from pictures of boards and markers."),
        Command("refine", "Refine a calibration from the moving balls themselves."),
        Command("sync", "Bring recordings started by hand together, by the balls' motion."),
        Command("check", "Say what is wrong or weak in a session before it is measured."),
    ),
    "Measure": (
        Command("run", "Measure a recorded session."),
        Command("live", "Measure cameras while they deliver."),
        Command("view", "Show a run in the viewer."),
        Command("report", "Write a run's report as one HTML file."),
        Command("evaluate", "Compare a run with the truth."),
        Command("export", "Write a run in another program's format."),
    ),
    "Correct a robot": (
        Command(
            "simulate", "Render a recording of the simulated RAVEN-II, with its log and its truth."
        ),
        Command("dataset", "Pair a robot's states with measured position errors."),
        Command("train", "Train an estimator of a robot's position error."),
        Command("sweep", "Search an estimator's settings, on many machines if there are."),
        Command("ablate", "Find out which inputs an estimator needs."),
        Command("estimate", "Correct a robot's positions, live or from a file."),
    ),
    "Extend": (Command("plugins", "List and describe the installed plugins."),),
}

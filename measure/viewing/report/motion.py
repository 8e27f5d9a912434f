"""How a body moved and turned, how fast, and how its poses scatter and drift."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.metrology.noise import Noise
from measure.results import Run
from measure.results.pose_table import noise_about, noise_at_rest, poses_of
from measure.viewing.report import figures
from measure.viewing.report.page import Page


def add_motion(page: Page, run: Run, since_start_s: Floats) -> None:
    """Rotation and speed over time, of the unflagged poses; gaps where there is none."""
    turned, speed, spin = _motion(run)
    drawn = zip("xyz", turned.T, strict=True)
    page.figures(
        "Rotation and speed",
        "Rotation from the first unflagged pose, as a rotation vector along the world's axes; "
        "speeds from the pose before to the pose after. Gaps are as in the position.",
        figures.over_time(since_start_s, dict(drawn), "rotation [deg]", figures.AXIS_COLORS),
        figures.over_time(since_start_s, {"speed": speed}, "speed [mm/s]"),
        figures.over_time(since_start_s, {"rotation": spin}, "angular speed [deg/s]"),
    )


def _motion(run: Run) -> tuple[Floats, Floats, Floats]:
    """Rotation vectors (n, 3) deg from the first unflagged pose, speeds (n,) mm/s and deg/s."""
    n, rows = run.poses.num_rows, np.flatnonzero(run.unflagged)
    place, turn = np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan)
    poses = poses_of(run).world_from_body
    place[rows], turn[rows] = poses.translation, poses.rotation
    turned, speed, spin = np.full((n, 3), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    if not len(rows):
        return turned, speed, spin
    turned[rows] = np.degrees((poses @ poses[0].inverse()).rotvec)
    middle = rows[(rows > 0) & (rows < n - 1)]
    middle = middle[np.isfinite(place[middle - 1, 0]) & np.isfinite(place[middle + 1, 0])]
    before, after = (RigidTransform(turn[k], place[k]) for k in (middle - 1, middle + 1))
    moved = after.difference(before)
    seconds = run.times_s[middle + 1] - run.times_s[middle - 1]
    speed[middle] = np.linalg.norm(moved[:, :3], axis=1) / seconds
    spin[middle] = np.degrees(np.linalg.norm(moved[:, 3:], axis=1)) / seconds
    return turned, speed, spin


def add_noise(page: Page, run: Run, errors: Floats | None) -> None:
    """Noise and drift about the truth by errors (n, 6), else at rest; nothing without either."""
    found = noise_at_rest(run) if errors is None else noise_about(run, errors)
    if found is None:
        return
    page.table(
        "Noise and drift",
        f"Of the unflagged poses about {found.about}, 3-D. What all poses err by alike is no "
        "noise: it does not show here.",
        ("", "position mm", "rotation deg"),
        found.rows(),
    )
    page.figures(
        "What averaging gains",
        "Allan deviation: by how much means of so many seconds scatter; where it rises again, "
        "poses drift. Root of the spectral density: at which frequencies they scatter.",
        *_noise_figures(found),
    )


def _noise_figures(found: Noise) -> list[go.Figure]:
    names = ("position [mm]", "rotation [deg]")
    mean = dict(zip(names, found.allan.T, strict=True))
    drawn = [figures.log_log(found.averaging_s, mean, "averaged over [s]", "Allan deviation")]
    if len(found.frequency_hz):
        density = dict(zip(names, found.density.T, strict=True))
        label = "density [per root Hz]"
        drawn.append(figures.log_log(found.frequency_hz, density, "frequency [Hz]", label))
    return drawn

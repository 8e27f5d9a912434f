"""A run's report: from its tables to one page."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pyarrow as pa
import pyarrow.compute as pc

from measure.arrays import Floats, Ints
from measure.geometry import RigidTransform
from measure.limits import MOST_LISTED, SINCE_1970_S
from measure.metrology.noise import Noise
from measure.results import Run, Summary
from measure.results.pose_table import noise_about, noise_at_rest, poses_of
from measure.results.summary import WHICH_ACCURACY
from measure.results.tables import texts
from measure.session import dump_toml
from measure.viewing.report import figures, places
from measure.viewing.report.page import Page
from measure_lab import run_figures
from measure_lab.accuracy import accuracy_map
from measure_lab.verdict import verdict


def run_report(
    runs: Sequence[Run],
    errors: Sequence[Floats | None] = (),
    picture: tuple[int, bytes] | None = None,
    axes: str = "the cameras' world",
) -> str:
    """The report as HTML, of each body's run, finished or not, also without any pose.

    With the errors (n, 6) of the poses against truth in the `perturb` chart, NaN where unknown; and
    a frame set with a JPEG file of its views with what was found drawn in; and whose axes x, y and
    z are.
    """
    errors = errors or [None] * len(runs)
    verdicts = [verdict(run, off) for run, off in zip(runs, errors, strict=True)]
    tone = max((tone for tone, _ in verdicts), key=("good", "doubtful", "bad").index)
    several = len(runs) > 1
    said = [
        f"{run.body.name}: {text}" if several else text
        for run, (_, text) in zip(runs, verdicts, strict=True)
    ]
    page = Page(_title(runs[0]), "\n".join(said), tone, when=_when(runs[0]))
    for run, off in zip(runs, errors, strict=True):
        page.about = f"{run.body.name}: " if several else ""
        page.facts(_facts(run))
        if off is not None:
            _add_errors(page, run, off, axes)
        if run.has_pose.any():
            _add_poses(page, run, axes)
            add_motion(page, run, since_start(run), axes)
            add_noise(page, run, off)
            _add_accuracy(page, run)
        if run.detections.num_rows:
            _add_views(page, run)
        _add_moves(page, run)
        _add_distances(page, run)
    page.about = ""
    if picture is not None:
        index, jpeg = picture
        page.picture("As the cameras saw it", f"Frame set {index}. {_DRAWN}", jpeg)
    _add_provenance(page, runs)
    return page.render("Made by measure report. Everything on this page is inside this file.")


_DRAWN = (
    "White: the outline of each ball used, as the measured pose puts it; grey and dashed: a ball "
    "not used in that view. The body's axes are x red, y green, z blue."
)


def since_start(run: Run) -> Floats:
    """Times (n,) of the frame sets since the first one, s."""
    return run.times_s - run.times_s[:1]


def _title(run: Run) -> str:
    """Names the run, unless it is called just that, and a recording that is called otherwise."""
    name = run.path.resolve().name
    session = run.provenance.get("session", {})
    recording = session.get("name") or Path(session.get("path", "")).name
    title = "Run" if name == "run" else f"Run {name}"
    return title if recording in ("", name) else f"{title} of {recording}"


def _facts(run: Run) -> Iterator[tuple[str, str]]:
    summary: Summary = run.summary
    yield "frame sets", str(summary.frame_sets)
    yield "ok / flagged", f"{summary.ok} / {summary.flagged}"
    yield "lost / skipped", f"{summary.lost} / {summary.skipped}"
    for label, value, unit in (
        ("median position SD", summary.position_sd_mm, "mm"),
        ("median rotation SD", summary.rotation_sd_deg, "deg"),
        ("median reprojection RMS", summary.rms_px, "px"),
    ):
        if np.isfinite(value):
            yield label, f"{value:.3g} {unit}"
    if run.poses.num_rows:
        yield "duration", f"{run.times_s[-1] - run.times_s[0]:.1f} s"


def _when(run: Run) -> str:
    """When it was recorded, if the times are dated, and measured."""
    said = []
    if run.poses.num_rows and run.times_s[0] > SINCE_1970_S:
        begun = datetime.fromtimestamp(run.times_s[0], UTC)
        said.append(f"Recorded {begun:%Y-%m-%d %H:%M:%S} UTC")
    if started := run.provenance.get("run", {}).get("started"):
        said.append(f"measured {datetime.fromisoformat(started):%Y-%m-%d %H:%M} UTC")
    text = ", ".join(said)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _add_errors(page: Page, run: Run, errors: Floats, axes: str) -> None:
    curves = _by_axis(errors[:, :3]) | {"3d": np.linalg.norm(errors[:, :3], axis=1)}
    turn = np.degrees(np.linalg.norm(errors[:, 3:], axis=1))
    page.figures(
        "Error against truth",
        f"Measured minus true position, in axes of {axes}; gaps are frame sets without a pose.",
        figures.over_time(since_start(run), curves, "error [mm]", figures.AXIS_COLORS),
        figures.over_time(since_start(run), {"rotation": turn}, "error [deg]"),
        figures.histograms(errors[:, :3], ("x", "y", "z"), "error [mm]"),
        figures.histograms(turn[:, None], ("rotation",), "error [deg]"),
    )


def _add_poses(page: Page, run: Run, frame: str) -> None:
    has = run.has_pose
    sd = run.poses["position_sd_mm"].to_numpy()
    sure, doubtful = _sure_and_doubtful(run)
    centers = np.stack([camera.center for camera in run.cameras])
    names = [camera.name for camera in run.cameras]
    page.figures(
        "Trajectory",
        "Where the body's origin went, and how well each position is known; then as seen along "
        "each axis. The line has a gap where there is no pose, and where one is flagged: those "
        "are loose points.",
        places.trajectory(sure, sd, centers, names, doubtful),
        *(places.plan(sure, axes, doubtful) for axes in _PLANES),
    )
    axes = np.full((len(has), 3), np.nan)
    axes[has] = np.sqrt(np.diagonal(run.covariances, axis1=1, axis2=2)[:, :3])
    curves = _by_axis(axes) | {"3d": sd}
    turn = run.poses["rotation_sd_deg"].to_numpy()
    page.figures(
        "Uncertainty",
        "Reported standard deviations; a gap is a frame set without a pose. In numbers, "
        f"{WHICH_ACCURACY['stated']}.",
        figures.over_time(since_start(run), curves, "SD [mm]", figures.AXIS_COLORS),
        figures.over_time(since_start(run), {"rotation": turn}, "SD [deg]"),
    )
    middle = np.nanmedian(sure, axis=0) if np.isfinite(sure).any() else np.zeros(3)
    page.figures(
        "Position",
        f"In axes of {frame}; the curves have gaps where there is no pose, or a flagged one.",
        figures.over_time(since_start(run), _by_axis(sure), "position [mm]", figures.AXIS_COLORS),
        figures.histograms(sure - middle, ("x", "y", "z"), "about the median [mm]"),
    )


def _sure_and_doubtful(run: Run) -> tuple[Floats, Floats]:
    """Positions (n, 3), NaN where there is no pose or a flagged one; and those flagged (k, 3)."""
    flagged, xyz = run.has_pose & ~run.unflagged, np.full((run.poses.num_rows, 3), np.nan)
    xyz[run.has_pose] = run.world_from_body.translation
    return np.where(flagged[:, None], np.nan, xyz), xyz[flagged]


def _by_axis(values: Floats) -> dict[str, Floats]:
    return dict(zip("xyz", values.T, strict=True))


def _add_accuracy(page: Page, run: Run) -> None:
    maps = [accuracy_map(run, axes) for axes in _PLANES[:2]]
    if not all(np.isfinite(m.sd_mm).any() for m in maps):
        return
    source = (
        "the cameras' own uncertainty included"
        if maps[0].from_calibration
        else ("without the cameras' own uncertainty, which the calibration file does not state")
    )
    path, _ = _sure_and_doubtful(run)
    page.figures(
        "Accuracy over the workspace",
        "Expected standard deviation of the position, 3-D, if every ball is in sight: the geometry "
        f"of cameras and body, scaled to what this run reported along its path; {source}. White: "
        "the path. Empty: seen by too few cameras.",
        *(places.accuracy(m.across_mm, m.up_mm, m.sd_mm, m.axes, path) for m in maps),
    )


def _add_views(page: Page, run: Run) -> None:
    codes, views, reasons = _states(run)
    page.figures(
        "Who saw what when",
        "Each ball in each camera: effective, or suspended and why. Where frame sets are many, a "
        "column stands for several and shows the commonest reason against a view among them.",
        run_figures.state_timeline(since_start(run), codes, views, reasons),
    )
    seen = {name: run.detections[name].to_numpy(zero_copy_only=False) for name in _RESIDUAL}
    _add_residuals(page, run, seen)


def _add_residuals(page: Page, run: Run, seen: Mapping[str, Any]) -> None:
    """Residuals by camera, and why frame sets are flagged."""
    size = np.hypot(seen["residual_u_px"], seen["residual_v_px"])
    rows, columns = [], []
    for camera in run.cameras:
        own = np.where((seen["camera"] == camera.name) & np.isfinite(size), size, np.nan)
        columns.append(own)
        kept = own[np.isfinite(own)]
        if len(kept):
            high, rms = np.quantile(kept, 0.95), np.sqrt(np.mean(kept**2))
            rows.append((camera.name, len(kept), *map(float, (np.median(kept), high, rms))))
    page.table(
        "Residuals by camera",
        "Distances of detected from predicted ball centres. One camera far above the others was "
        "moved, is late, or sees badly.",
        ("camera", "balls", "median px", "95 % px", "RMS px"),
        rows,
    )
    if rows:
        names, label = [camera.name for camera in run.cameras], "residual [px]"
        drawn = figures.histograms(np.column_stack(columns), names, label, "balls")
        page.figures("How large residuals are", "", drawn)
    flagged = run.has_pose & ~run.unflagged
    why = texts(run.poses, "reason")[flagged]
    if len(why):
        begun = since_start(run)[flagged]
        counted = Counter(why.tolist()).most_common(MOST_LISTED)
        page.table(
            "Flagged frame sets",
            "Why poses are doubtful, the commonest reasons first.",
            ("reason", "frame sets", "first at s"),
            [(reason, n, float(begun[np.argmax(why == reason)])) for reason, n in counted],
        )


_PLANES = ((0, 1), (0, 2), (1, 2))
_RESIDUAL = ("camera", "residual_u_px", "residual_v_px")


def _states(run: Run) -> tuple[Ints, list[str], list[str]]:
    """Code of every ball and camera over the frame sets; code 0 is effective."""
    given = pc.unique(run.detections["reason"]).to_pylist()
    reasons = ["effective", *sorted(reason for reason in given if reason)]
    views = [f"{ball} in {camera.name}" for camera in run.cameras for ball in run.body.names]
    # A skipped frame set has no views: shown as the last code, "not looked at".
    reasons.append("not looked at")
    codes = np.full((len(views), run.poses.num_rows), len(reasons) - 1, dtype=np.int64)
    seen = run.detections
    view = pc.binary_join_element_wise(seen["ball"], seen["camera"], " in ")
    reason = pc.if_else(pc.equal(seen["reason"], ""), "effective", seen["reason"])
    at = seen["index"].to_numpy()  # frame sets count from 0, without gaps
    codes[pc.index_in(view, pa.array(views)).to_numpy(), at] = pc.index_in(
        pc.fill_null(reason, "effective"), pa.array(reasons)
    ).to_numpy()
    return codes, views, reasons


def _add_moves(page: Page, run: Run) -> None:
    """Cameras that were moved meanwhile, and from when to when they were left out."""
    if not run.camera_moves:
        return
    begun = run.times_s[0]
    page.table(
        "Cameras that were moved",
        "When each was moved, from when on it was used again where it stood then, and how far that "
        "is from where it was before. `run.toml` has its new pose with the covariance.",
        ("camera", "moved at s", "used again at s", "shift mm", "turn deg", "its SD deg"),
        [
            (
                one.camera,
                one.since_s - begun,
                None if one.until_s is None else one.until_s - begun,
                *(one.shift_mm, one.turn_deg, one.turn_sd_deg),
            )
            for one in run.camera_moves
        ],
    )


def _add_distances(page: Page, run: Run) -> None:
    """The body measured with itself: its balls' distances against the body file."""
    found = run.distances
    names = ["-".join(one.balls) for one in found]
    rows = [
        (name, one.nominal_mm, one.mean_mm, one.off_mm, one.uncertainty_mm, one.count)
        for name, one in zip(names, found, strict=True)
    ]
    curves = {
        name: one.measured_mm - one.nominal_mm for name, one in zip(names, found, strict=True)
    }
    page.table(
        "Ball distances",
        "By rays alone, and by the body file; a difference far above its uncertainty means "
        "that the file or the calibration is off by that much.",
        ("balls", "nominal mm", "measured mm", "difference mm", "uncertainty mm", "frame sets"),
        rows,
    )
    if run.balls.num_rows:
        page.figures(
            "Ball distances over time",
            "Measured minus nominal.",
            figures.over_time(since_start(run), curves, "difference [mm]"),
        )


def _add_provenance(page: Page, runs: Sequence[Run]) -> None:
    run = runs[0]
    words = "The cameras as used. Standard deviations are those that the calibration file states."
    places.add_cameras(page, words, run.cameras)
    file = Path(run.provenance.get("session", {}).get("path", "SESSION"))
    session = file.parent.name if file.name == "session.toml" else file.name
    calibration = Path(run.provenance.get("calibration", {}).get("path", "CALIBRATION")).name
    own = Path(run.path.resolve().name)
    again = ["measure", "run", session, "--out", "NEW", "--profile", str(own / "run.toml")]
    again += ["--calibration", calibration]
    again += ["--body", str(own / "body.toml")] if not run.several else []
    page.text(
        "How to repeat it",
        "With the same versions it gives the same poses to the last digit. The run's folder holds "
        "every setting, the body, and a copy of the calibration should the original be lost. Names "
        "stand here without their folders.",
        shlex.join(again),
    )
    page.text("Settings and versions", "", dump_toml(_without_folders(run.provenance)))


def _without_folders(value: Any) -> Any:
    """Values with absolute paths cut to names: a page is made to be sent to others."""
    if isinstance(value, Mapping):
        return {key: _without_folders(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_folders(one) for one in value]
    return Path(value).name if isinstance(value, str) and Path(value).is_absolute() else value


def add_motion(page: Page, run: Run, since_start_s: Floats, axes: str) -> None:
    """Rotation and speed over time, of the unflagged poses; gaps where there is none."""
    turned, speed, spin = _motion(run)
    drawn = zip("xyz", turned.T, strict=True)
    page.figures(
        "Rotation and speed",
        f"Rotation from the first unflagged pose, as a rotation vector along axes of {axes}; "
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
    drawn = [run_figures.log_log(found.averaging_s, mean, "averaged over [s]", "Allan deviation")]
    if len(found.frequency_hz):
        density = dict(zip(names, found.density.T, strict=True))
        label = "density [per root Hz]"
        drawn.append(run_figures.log_log(found.frequency_hz, density, "frequency [Hz]", label))
    return drawn

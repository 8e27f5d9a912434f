"""A run's report: from its tables to one page.

Its map shows how well the body's position can be known across the workspace of the run.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pyarrow as pa
import pyarrow.compute as pc

from measure.arrays import Floats, Ints
from measure.estimation.expected_accuracy import body_pose_sd, noise_sd, tolerance_sd
from measure.geometry import RigidTransform
from measure.limits import MOST_LISTED, SINCE_1970_S, SPREAD_OVER
from measure.metrology.noise import Noise
from measure.model.doubts import counted
from measure.results import Run, Summary
from measure.results.pose_table import noise_about, noise_at_rest, poses_of
from measure.results.rig_changes import moved_by
from measure.results.summary import WHICH_ACCURACY
from measure.results.tables import doubts_of
from measure.session import dump_toml
from measure.viewing.report import figures
from measure.viewing.report.page import Page
from measure.viewing.state_colors import css
from measure_lab.verdict import verdict

_STEPS = 11
_MIN_REACH_MM = 60.0
_MAP_SIZE_RATIO = 1.5  # How far the map goes beyond the places where the body was


@dataclass(frozen=True, eq=False)
class AccuracyMap:
    """Expected error of the body's position over a plane through the middle of the workspace."""

    axes: tuple[int, int]  # the two world axes of the plane: 0 is x, 1 y, 2 z
    across_mm: Floats  # (n,) coordinates along the first
    up_mm: Floats  # (m,) along the second
    sd_mm: Floats  # (m, n) standard deviation of the position, 3-D; NaN where it cannot be measured
    from_calibration: bool  # whether the cameras' own uncertainty is in it


def accuracy_map(run: Run, axes: tuple[int, int]) -> AccuracyMap:
    """What one may expect elsewhere in the workspace, with every ball in sight.

    The geometry of cameras and body says how errors grow from place to place; how large they are is
    what the run, with at least one pose, reported along its path, and the calibration's part
    (camera by camera) is kept apart from that of the pictures. The body keeps the turn it had in
    the middle of the run.
    """
    place = run.world_from_body.translation
    low, high = place.min(axis=0), place.max(axis=0)
    middle = (low + high) / 2
    reach = np.maximum(_MAP_SIZE_RATIO * (high - low) / 2, _MIN_REACH_MM)
    turn = run.world_from_body.rotation[len(place) // 2]
    steps = np.linspace(-1, 1, _STEPS)
    across, up = (middle[axis] + reach[axis] * steps for axis in axes)
    noise_px = reported_noise_px(run)
    sd = np.empty((_STEPS, _STEPS))
    for row, column in np.ndindex(sd.shape):
        at = middle.copy()
        at[list(axes)] = across[column], up[row]
        per_px, fixed = _parts(RigidTransform(turn, at), run)
        sd[row, column] = np.hypot(noise_px * per_px, fixed)
    known = any(camera.pose_covariance is not None for camera in run.cameras)
    return AccuracyMap(axes, across, up, sd, known)


def reported_noise_px(run: Run) -> float:
    """The noise of a ball's centre in a picture that explains the uncertainty the run reported.

    Larger than the scatter of the outlines, because the reported uncertainty also holds what no
    single frame can show. The median over poses spread along the run.
    """
    picked = np.unique(np.linspace(0, int(run.has_pose.sum()) - 1, SPREAD_OVER).astype(int))
    reported = np.sqrt(np.trace(run.covariances[picked, :3, :3], axis1=1, axis2=2))
    parts = np.array([_parts(run.world_from_body[int(k)], run) for k in picked])
    seen = np.isfinite(parts).all(axis=1)
    if not seen.any():
        return float("nan")
    beside = np.maximum(reported**2 - parts[:, 1] ** 2, 0.0)[seen]
    return float(np.sqrt(np.median(beside / parts[seen, 0] ** 2)))


def _parts(pose: RigidTransform, run: Run) -> tuple[float, float]:
    """SD of the position in mm by a px of noise, and by calibration and body; NaN if unseen."""
    points = pose.apply(run.body.centers)
    cameras = tuple(c for c in run.cameras if c.intrinsics.contains(c.project(points)).any())
    per_px, _ = noise_sd(pose, run.body, cameras, 1.0)
    if not np.isfinite(per_px):
        return float("nan"), float("nan")
    from_cameras, _ = body_pose_sd(cameras, run.body, [pose])
    from_body, _ = tolerance_sd(run.body, pose)
    return per_px, math.hypot(from_cameras[0], from_body)


def log_log(
    across: Floats, curves: Mapping[str, Floats], label: str, other_label: str
) -> go.Figure:
    """Curves (n,) by name over positive values (n,), both axes logarithmic."""
    figure = figures.blank(x=label, y=other_label)
    for (name, values), color in zip(curves.items(), figures.PALETTE, strict=False):
        figure.add_scatter(x=across, y=values, name=name, mode="lines", line={"color": color})
    figure.update_xaxes(type="log")
    figure.update_yaxes(type="log", exponentformat="power")
    return figure


def state_timeline(
    times_s: Floats, codes: Ints, views: Sequence[str], reasons: Sequence[str]
) -> go.Figure:
    """Who saw what when, by codes (views, n) into `reasons`, 0 effective; the commonest if many."""
    count = len(times_s)
    ends = np.linspace(0, count, min(count, figures.MAX_POINTS) + 1).astype(np.int64)
    shown = codes if count <= figures.MAX_POINTS else _commonest(codes, ends)
    colors = [css(reason) for reason in reasons]
    top = max(len(reasons) - 1, 1)
    steps = [(code + end) / (top + 1) for code in range(len(reasons)) for end in (0, 1)]
    figure = figures.blank(90 + 22 * len(views), x="time since the start [s]")
    figure.add_heatmap(
        x=times_s[ends[:-1]],
        y=list(views),
        z=shown.astype(np.int8),
        zmin=-0.5,
        zmax=top + 0.5,
        colorscale=list(zip(steps, np.repeat(colors, 2), strict=True)),
        ygap=2,
        showscale=False,
    )
    for reason, color in zip(reasons, colors, strict=True):
        marker = {"symbol": "square", "size": 10, "color": color}
        figure.add_scatter(x=[None], y=[None], mode="markers", marker=marker, name=reason)
    figure.update_yaxes(autorange="reversed")
    return figure


def _commonest(codes: Ints, ends: Ints) -> Ints:
    """Of each stretch of codes (views, n) the commonest but 0; 0 where all are."""
    counts = [
        np.add.reduceat(codes == code, ends[:-1], axis=1) for code in range(1, int(codes.max()) + 1)
    ]
    if not counts:
        return np.zeros((len(codes), len(ends) - 1), dtype=np.int64)
    return np.where(np.any(counts, axis=0), 1 + np.argmax(counts, axis=0), 0)


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
        figures.trajectory(sure, sd, centers, names, doubtful),
        *(figures.plan(sure, axes, doubtful) for axes in _PLANES),
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
        *(figures.accuracy(m.across_mm, m.up_mm, m.sd_mm, m.axes, path) for m in maps),
    )


def _add_views(page: Page, run: Run) -> None:
    codes, views, reasons = _states(run)
    page.figures(
        "Who saw what when",
        "Each ball in each camera: effective, or suspended and why. Where frame sets are many, a "
        "column stands for several and shows the commonest reason against a view among them.",
        state_timeline(since_start(run), codes, views, reasons),
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
    doubts, begun = doubts_of(run.poses), since_start(run)
    flagged = np.flatnonzero(run.has_pose & ~run.unflagged).tolist()
    if flagged:
        first = {one.kind: float(begun[k]) for k in reversed(flagged) for one in doubts[k]}
        kinds = list(counted(doubts[k] for k in flagged).items())[:MOST_LISTED]
        page.table(
            "Flagged frame sets",
            "Why poses are doubtful, the commonest reasons first.",
            ("reason", "frame sets", "first at s"),
            [(one, n, first[one.kind]) for one, n in kinds],
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
    """Cameras that were moved meanwhile, or drifted, and where they stood when."""
    if not run.camera_moves:
        return
    begun = run.times_s[0]
    page.table(
        "Cameras that were moved",
        "When each was moved, from when on it was used again where it stood then, and how far that "
        "is from where it was before. One that drifts is followed in steps, from the first to the "
        "last, and never left out. `run.toml` has the new poses with their covariance.",
        ("camera", "moved at s", "used again at s", "shift mm", "turn deg", "its SD deg"),
        [
            (
                f"{one.camera}, which drifts" if one.drifted else one.camera,
                one.since_s - begun,
                None if one.until_s is None else one.until_s - begun,
                *(one.shift_mm, one.turn_deg, one.turn_sd_deg),
            )
            for one in run.camera_moves
        ],
    )
    page.figures(
        "Where cameras stood",
        "How far each was moved from where it was calibrated, and turned, as the poses use it; "
        "grey: plus and minus a standard deviation. A gap: it was left out.",
        *(_ways(run, k, label) for k, label in enumerate(("shift [mm]", "turn [deg]"))),
    )


def _ways(run: Run, which: int, label: str) -> go.Figure:
    """How far cameras were shifted (0) or turned (1) over time, plus and minus an SD."""
    curves = dict[str, Floats]()
    for camera in run.cameras:
        way, name = np.zeros((run.poses.num_rows, 2)), camera.name
        own = [change for change in run.camera_changes if change.camera == name]
        for change in own:
            way[change.frame_set :] = np.nan
            if (pose := change.world_from_camera) is not None:
                far = moved_by(pose, camera.world_from_camera, change.covariance)
                way[change.frame_set :] = far[which]
        if own:
            size, sd = way.T
            curves |= {name: size, f"{name} + SD": size + sd, f"{name} - SD": size - sd}
    edges = {name: "#9aa5b1" for name in curves if name.endswith(" SD")}
    return figures.over_time(since_start(run), curves, label, edges)


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
    figures.add_cameras(page, words, run.cameras)
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
    drawn = [log_log(found.averaging_s, mean, "averaged over [s]", "Allan deviation")]
    if len(found.frequency_hz):
        density = dict(zip(names, found.density.T, strict=True))
        label = "density [per root Hz]"
        drawn.append(log_log(found.frequency_hz, density, "frequency [Hz]", label))
    return drawn

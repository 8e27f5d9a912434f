"""Calibrations refined, and body files found, by recordings in which the balls move."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from measure.api.measuring import calibrated_pipeline, search_frame_sets
from measure.api.outputs import check_apart, output
from measure.api.profiles import DEFAULT_PROFILE, build_detectors, load_profile
from measure.arrays import Floats
from measure.calibration import (
    RefinedRig,
    RefineSettings,
    refine_measured,
    refine_rig,
    rough_cameras,
)
from measure.calibration.refining.freeing import FreedRig, contradicted, freed
from measure.calibration.refining.procedure import AdjustedRig
from measure.calibration.refining.recording import recording_of
from measure.checking.unknown_body import (
    SeenBall,
    find_layout,
    left_out,
    locate,
    search_bodies,
    wrong_size,
)
from measure.errors import CalibrationError, ConfigError
from measure.geometry import RigidTransform, align_points
from measure.host import Registry
from measure.host.registry import suggestion
from measure.limits import MAX_STEPS, SIGNIFICANT_SIGMAS, SPREAD_OVER
from measure.measuring import Measurement, Profile
from measure.measuring.association import associate
from measure.model import BallColor, Body, Camera, Detection
from measure.model.body import USUAL_RADIUS_TOLERANCE_MM
from measure.processes import Progress, quiet
from measure.session import (
    JOINT_COVARIANCE,
    Calibration,
    Session,
    clock_values,
    open_session,
    read_body,
    read_calibration,
    write_body,
    write_calibration,
)

_log = logging.getLogger(__name__)

_ANY_PX = 100.0
"""Displacement of cameras, and of balls in them, from which a pose is flagged while refining."""

LOOSE_WORLD = (
    "the first calibration does not say how its cameras' errors hang together (`measure calibrate` "
    "does, of cameras located by markers or by a board of known pose), so the world frame may have "
    "moved a little while the cameras were sharpened against each other: do not trust absolute "
    "positions beyond that calibration's"
)


@dataclass(frozen=True, eq=False)
class RefineResult:
    """A refined calibration and how it came about."""

    calibration: Calibration
    rig: RefinedRig
    body: Body  # with its balls where the recording puts them, within the tolerance, and as large
    notes: tuple[str, ...] = ()
    freed: tuple[str, ...] = ()  # cameras that alone were free, as the others contradict them


def refine(
    session: Path | str,
    registry: Registry,
    out: Path | None = None,
    file_format: str = "triball",
    body_output: Path | None = None,
    overwrite: bool = False,
    profile: Profile | str = DEFAULT_PROFILE,
    calibration: Path | str | None = None,
    only: Sequence[str] = (),
    body_tolerance_mm: float | None = None,
    progress: Progress = quiet,
) -> RefineResult:
    """Refine a calibration from the moving balls themselves.

    A camera that the others contradict while they agree is freed alone, and said; they stay as they
    are. What would be shared out among all cameras (a zoom of all, another scale, a ball elsewhere,
    a camera moved midway) is refused.

    Args:
        session: recording in which the body is carried through the whole workspace.
        out: the calibration to write.
        file_format: triball, anipose, caliscope or opencv; only "triball" holds covariances and
            notes.
        body_output: body file to write, with the balls where the recording puts them.
        profile: how to measure the session, by name or TOML file.
        calibration: first calibration, if not the session's own.
        only: a camera to free, the others held; may be repeated.
        body_tolerance_mm: how exactly the balls sit on the body (standard deviation); 0 is exact;
            what the body file states, or 0.05, if omitted.

    Raises:
        CalibrationError: too little is seen, the result is implausible, or what is off is not
            some cameras' alone.
    """
    check_apart(*filter(None, (out, body_output)))
    with output(out, overwrite) as file, output(body_output, overwrite) as body:
        if body_tolerance_mm is not None and not 0 <= body_tolerance_mm < np.inf:
            raise ConfigError(f"--body-tolerance-mm {body_tolerance_mm:g}: must be 0 or more")
        settings, chosen = RefineSettings(body_tolerance_mm), lenient(load_profile(profile))
        result = _refined(session, registry, chosen, settings, calibration, progress, only)
        write_calibration(file, result.calibration, file_format)
        write_body(body, result.body)
    return result


def _refined(
    session: Path | str,
    registry: Registry,
    chosen: Profile,
    settings: RefineSettings,
    calibration: Path | str | None,
    progress: Progress,
    only: Sequence[str],
) -> RefineResult:
    with open_session(session, calibration=calibration) as opened:
        _check_names(only, opened.cameras)
        first, body, joint = opened.cameras, opened.body, joint_covariance(opened)
        measured, sized = measure_all(opened, chosen, registry, progress)
        names, alone = tuple(only) or contradicted(measured, body, first), None
        if names:
            try:
                recording = recording_of(measured, body, doubtful_too=True)
                rough = freed(first, names, body, recording, settings).refinement.cameras
                again = _measured_again(opened, rough, chosen, registry, progress)
                free = freed(first, names, body, recording_of(again[0], body), settings)
                alone = refine_measured(free.cameras, body, again[0], settings, free.joint)
                sized = again[1]
            except CalibrationError:
                if only:
                    raise
                names = ()  # They were a guess, which does not explain what is seen
        if alone is not None:
            cameras, joint = free.as_stated(alone.refinement, first, joint)
            rig = replace(alone, refinement=replace(alone.refinement, cameras=cameras))
            notes = (_freed_note(free, bool(only)), *rig.verdict.notes)
        else:
            rough_rig = rough_cameras(first, body, measured, settings, joint)
            if rough_rig is not None:
                measured, sized = _measured_again(opened, rough_rig, chosen, registry, progress)
            rig = refine_measured(first, body, measured, settings, joint)
            notes = rig.verdict.notes + (() if rig.refinement.world_held else (LOOSE_WORLD,))
            joint = rig.refinement.covariance
        clocks = clock_values(opened.clock_digest, clock_shifts(rig, opened.clock_shifts_s))
    values = _provenance(str(session), rig) | clocks | {"notes": list(notes)}
    if names:
        values["freed"] = list(names)
    if joint is not None:
        values[JOINT_COVARIANCE] = joint
    # The body to write: what is known of its radii becomes their tolerance
    sd_mm = float(np.sqrt(np.mean(np.diag(sized.radius_covariance))))
    refined = replace(sized.with_centers(rig.refinement.centers), radius_tolerance_mm=sd_mm)
    return RefineResult(Calibration(rig.refinement.cameras, values), rig, refined, notes, names)


def _measured_again(
    opened: Session,
    cameras: tuple[Camera, ...],
    profile: Profile,
    registry: Registry,
    progress: Progress,
) -> tuple[list[Measurement], Body]:
    """The session measured with roughly refined cameras."""
    _log.warning("the cameras disagree much: measuring again with roughly refined ones")
    return measure_all(replace(opened, cameras=cameras), profile, registry, progress)


def _check_names(only: Sequence[str], cameras: Sequence[Camera]) -> None:
    known = [camera.name for camera in cameras]
    for name in only:
        if name not in known:
            raise ConfigError(f"--only {name}: {suggestion(name, known, 'camera')}")
    if {*known} == {*only}:
        raise ConfigError("--only names all cameras: leave one at least that holds the world")


def _freed_note(free: FreedRig, asked: bool) -> str:
    held = ", ".join(c.name for c in free.cameras if c.name not in free.names)
    why = "" if asked else "the other cameras contradict it and agree among each other: "
    how = "moved" if free.moved else "zoomed or cropped"
    return f"{why}{' and '.join(free.names)} alone freed ({how}); {held} stay as they were"


def joint_covariance(opened: Session) -> Floats | None:
    """The covariance of all cameras together, where their calibration holds it."""
    known = read_calibration(opened.calibration_path).provenance.get(JOINT_COVARIANCE)
    return None if known is None else np.asarray(known, dtype=np.float64)


def lenient(profile: Profile) -> Profile:
    """The profile without flags for displaced cameras: refining corrects those."""
    if profile.tracking == "predictive":
        profile = profile.with_setting("tracking", "view_bias_px", _ANY_PX)
    if profile.solver == "contours":
        profile = profile.with_setting("solver", "max_shift_px", _ANY_PX)
    return profile


def measure_all(
    opened: Session, profile: Profile, registry: Registry, progress: Progress
) -> tuple[list[Measurement], Body]:
    """Every frame set measured, and the body with the radii that its outlines show."""
    pipeline, measured = calibrated_pipeline(opened, profile, registry), []
    for measurement in pipeline.measure(opened.frame_sets()):
        measured.append(measurement)
        progress(len(measured), None)
    return measured, pipeline.body


def clock_shifts(rig: AdjustedRig, before: Mapping[str, float]) -> dict[str, float]:
    """What to add to the stamps as recorded, by camera."""
    shifts = dict(before)
    if rig.clocks_applied:
        for clock in rig.clocks:
            shifts[clock.camera] = shifts.get(clock.camera, 0.0) + clock.offset_s
    return shifts


def _provenance(session: str, rig: RefinedRig) -> dict[str, object]:
    refinement, verdict = rig.refinement, rig.verdict
    clocks = {c.camera: c for c in rig.clocks if np.isfinite(c.offset_sd_s)}
    return {
        "refined_from": session,
        "frame_sets": refinement.frames,
        "clock_offsets_s": {name: clock.offset_s for name, clock in clocks.items()},
        "clock_sds_s": {name: clock.offset_sd_s for name, clock in clocks.items()},
        "clocks_applied": rig.clocks_applied,
        "ball_centers_mm": refinement.centers,
        "ball_center_sds_mm": refinement.center_sds,
        "view_scatter_px": refinement.noise.view_px,
        "constant_scatter_px": refinement.noise.constant_px,
        "camera_position_sd_mm": list(verdict.camera_sd_mm),
        "held_out_px": list(verdict.held_out_px),
        "surprise": verdict.surprise,
        "body_position_sd_mm": list(verdict.body_sd_mm),
    }


_ROUGH_MM, _FREE_MM = 0.5, 5.0
"""Standard deviations of a ball's centre: by the search alone, and while it is adjusted."""


@dataclass(frozen=True, eq=False)
class FoundBody:
    """A body as a recording shows it."""

    body: Body  # in the stated frame; its `tolerance_mm` is what is left of its uncertainty
    # (mm, standard deviation in mm) of every two balls.
    distances: Mapping[tuple[str, str], tuple[float, float]]
    # (mm, standard deviation in mm) of each ball, as its outlines show it; the body has the stated
    seen_radii: Mapping[str, tuple[float, float]]
    frame: str  # where its origin is and how its axes lie, in words
    frame_sets: int  # how many it rests on
    rms_px: float  # of what is left of the balls' centres in the pictures
    left_out: tuple[str, ...] = ()  # what else was seen, and why it is no ball of the body


@dataclass(frozen=True)
class BodySearch:
    """Which body is looked for, and how.

    Attributes:
        radius_mm: radius of each ball.
        like: body file with the balls' names and colours and the frame to use; needed where two
            balls have one colour, or one that has no common name.
        origin: ball to put the origin at; the centroid of all if omitted.
        calibration: a calibration to use instead of the session's.
        profile: how to measure the session, by name or TOML file.
    """

    radius_mm: float
    like: Path | None = None
    origin: str | None = None
    calibration: Path | None = None
    profile: str = DEFAULT_PROFILE


def find_body(
    session: Path | str,
    registry: Registry,
    search: BodySearch,
    progress: Progress = quiet,
    *,
    learnt: Mapping[str, BallColor] | None = None,
    without: Collection[str] = (),
) -> FoundBody:
    """Find a body's balls in a recording, and adjust their places to all its pictures.

    The session needs no body, and one that it names is not read. SessionError: fewer than three
    balls, two of one colour, or balls of another size.

    Args:
        learnt: colours of balls, by name, that are searched beside the common ones.
        without: common colours that are not searched.
    """
    radius_mm, origin = search.radius_mm, search.origin
    if not 0 < radius_mm < np.inf:
        raise ConfigError(f"--radius-mm {radius_mm:g}: expected a length in mm above 0")
    pattern = None if search.like is None else _of_size(read_body(search.like), radius_mm)
    chosen = load_profile(search.profile)
    searched = [pattern] if pattern else search_bodies(radius_mm, learnt, without)
    with open_session(session, search.calibration, searched[0]) as opened:
        frames = list(_searched(opened, searched, pattern, chosen, registry, progress))
        # Only names, colours and radii of these count.
        every = replace(searched[0], balls=tuple(b for body in searched for b in body.balls))
        rough = find_layout(frames, every, pick=pattern is None)
        if origin is not None and origin not in rough.names:
            raise ConfigError(
                f"--origin {origin}: there is no such ball, but {', '.join(rough.names)}"
            )
        rough = replace(rough, name="body" if pattern is None else pattern.name)
        try:
            found = _adjusted(opened, rough, pattern, origin, chosen, registry, progress)
        except CalibrationError as problem:
            size = wrong_size(frames, rough)
            raise CalibrationError(f"{size} ({problem})" if size else str(problem)) from None
        return replace(found, left_out=left_out(frames, every, rough.names))


def _of_size(body: Body, radius_mm: float) -> Body:
    return replace(body, balls=tuple(replace(ball, radius_mm=radius_mm) for ball in body.balls))


def _searched(
    session: Session,
    probes: Sequence[Body],
    pattern: Body | None,
    profile: Profile,
    registry: Registry,
    progress: Progress,
) -> Iterator[dict[str, SeenBall]]:
    """The balls located in frame sets spread over the recording, by whole pictures."""
    searches = [build_detectors(profile, registry, body, session.cameras) for body in probes]
    total = len(session.pair().times_s)
    chosen = np.unique(np.linspace(0, total - 1, min(SPREAD_OVER, total)).round().astype(int))
    for done, (_, found) in enumerate(search_frame_sets(session, searches, chosen.tolist()), 1):
        located: dict[str, SeenBall] = {}
        for body, seen in zip(probes, found, strict=True):
            if body is pattern:
                # A known layout has separated other things of these colours: two rays will do.
                mine = _of_this_body(seen, body, session)
                located |= locate(mine, body, session.cameras, 2)
            else:
                located |= locate(seen, body, session.cameras)
        progress(done, len(chosen) + total)
        yield located


def _of_this_body(
    seen: Mapping[str, list[Detection]], body: Body, session: Session
) -> Mapping[str, list[Detection]]:
    """Those that lie as in a file with this layout; all if none do, and no colour repeats."""
    found = associate(body, session.cameras, seen)
    if found.world_from_body is None and len({b.color for b in body.balls}) == len(body.balls):
        return seen
    kept: dict[str, list[Detection]] = {name: [] for name in seen}
    for detection in found.detections:
        kept[detection.camera].append(detection)
    return kept


def _adjusted(
    session: Session,
    rough: Body,
    pattern: Body | None,
    origin: str | None,
    profile: Profile,
    registry: Registry,
    progress: Progress,
) -> FoundBody:
    """Measure the recording with a rough body, and adjust that by bundle adjustment."""
    first, total = replace(rough, tolerance_mm=_ROUGH_MM), len(session.pair().times_s)
    searched = min(SPREAD_OVER, total)
    how = lenient(profile), registry, lambda done, _: progress(searched + done, searched + total)
    for _ in range(2):  # The first pass finds sizes that are off by percents only roughly
        measured, sized = measure_all(replace(session, body=first), *how)
        sds = np.sqrt(np.diag(sized.radius_covariance))
        if np.all(np.abs(sized.radii - first.radii) <= SIGNIFICANT_SIGMAS * sds):
            break
        first = replace(first, balls=sized.balls)
    recording = recording_of(measured, sized, least_motion_mm=0.0)
    free = RefineSettings(body_tolerance_mm=_FREE_MM)
    refined = refine_rig(session.cameras, sized, recording, free, joint_covariance(session))
    distances = _distances(sized.names, refined.centers, refined.center_covariance)
    variance = np.mean([sd**2 for _, sd in distances.values()])
    place, words = _frame(refined.centers, sized.names, pattern, origin, distances)
    # Digits that say nothing only disturb who edits the file by hand; nor does a zero have a sign.
    centers = np.round(place.inverse().apply(refined.centers), 4) + 0.0
    body = replace(
        _of_size(sized, rough.radii[0]).with_centers(centers),
        tolerance_mm=round(float(np.sqrt(variance / 2)), 4),
    )
    rms = float(np.sqrt(np.mean([after**2 for _, after in refined.rms_px.values()])))
    sizes = zip(sized.radii.tolist(), sds.tolist(), strict=True)
    seen = dict(zip(sized.names, sizes, strict=True))
    return FoundBody(body, distances, seen, words, refined.frames, rms)


def _distances(
    names: tuple[str, ...], centers: Floats, covariance: Floats
) -> dict[tuple[str, str], tuple[float, float]]:
    """Distances and their standard deviations: a turn of the whole body changes none."""
    out = {}
    for i, j in combinations(range(len(names)), 2):
        way = centers[i] - centers[j]
        length = float(np.linalg.norm(way))
        by_center = np.zeros(centers.shape)
        by_center[i], by_center[j] = way / length, -way / length
        row = by_center.ravel()
        out[names[i], names[j]] = (length, float(np.sqrt(row @ covariance @ row)))
    return out


def _frame(
    centers: Floats,
    names: tuple[str, ...],
    pattern: Body | None,
    origin: str | None,
    distances: Mapping[tuple[str, str], tuple[float, float]],
) -> tuple[RigidTransform, str]:
    """The frame of the new body, in that of `centers`, and in words."""
    at = centers.mean(axis=0) if origin is None else centers[names.index(origin)]
    where = "the balls' centroid" if origin is None else f"ball {origin}"
    if pattern is not None:
        like, fitted = _frame_like(centers, names, pattern, distances)
        if origin is None:
            return like, f"origin and axes of the body it is like, {fitted}"
        words = f"origin at {where}, axes of the body it is like, {fitted}"
        return RigidTransform(like.rotation, at), words
    x = (centers[1] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
    normals = np.cross(x, centers - centers[0])
    third = int(np.argmax(np.linalg.norm(normals, axis=1)))
    z = normals[third] / np.linalg.norm(normals[third])
    words = (
        f"origin at {where}, x along the way from {names[0]} to {names[1]}, y in the plane "
        f"of these and {names[third]}, towards it"
    )
    return RigidTransform(np.stack([x, np.cross(z, x), z], axis=1), at), words


_OFF_SIGMAS, _OFF_MM = 4.0, 0.1  # By which a distance differs from the file's, at least


def _frame_like(
    centers: Floats,
    names: tuple[str, ...],
    pattern: Body,
    distances: Mapping[tuple[str, str], tuple[float, float]],
) -> tuple[RigidTransform, str]:
    """The frame in which balls lie as in a file, by those that agree among each other; in words.

    One ball that does not is put where its distances from the others say, as near as can be to
    where the file has it: that place holds the frame of three balls, too.
    """
    stated = pattern.centers_of(names)
    known = max(pattern.tolerance_mm, USUAL_RADIUS_TOLERANCE_MM)
    off = {}
    for (a, b), (mm, sd) in distances.items():
        filed = float(np.linalg.norm(stated[names.index(a)] - stated[names.index(b)]))
        off[a, b] = abs(filed - mm) > max(_OFF_SIGMAS * float(np.hypot(sd, known)), _OFF_MM)
    alone = [name for name in names if not any(o for pair, o in off.items() if name not in pair)]
    whole = align_points(centers, stated)
    if not any(off.values()):
        return whole, "fitted to all balls"
    if len(alone) != 1:
        apart = np.linalg.norm(whole.inverse().apply(centers) - stated, axis=1).max()
        return whole, (
            f"fitted to all balls, which lie up to {apart:.2f} mm from where that file says: their "
            "distances do not tell which of them is off, and the frame may be off as much"
        )
    k, others = names.index(alone[0]), [n != alone[0] for n in names]
    lengths = np.linalg.norm(centers[others] - centers[k], axis=1)
    place = stated[k]
    for _ in range(MAX_STEPS):  # Gauss-Newton, the shortest step of those that will do
        ways = place - stated[others]
        now = np.linalg.norm(ways, axis=1)
        place = place + np.linalg.pinv(ways / now[:, None]) @ (lengths - now)
    mended = stated.copy()
    mended[k] = place
    like = align_points(centers, mended)
    moved = np.linalg.norm(like.inverse().apply(centers) - whole.inverse().apply(centers), axis=1)
    return like, (
        f"fitted to {', '.join(n for n in names if n != alone[0])}: {alone[0]} lies "
        f"{np.linalg.norm(place - stated[k]):.2f} mm from where that file says (fitted to it, too, "
        f"the frame would have moved by up to {moved.max():.2f} mm)"
    )

"""A robot registered to the cameras: its base, the body on its tool, and the clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError
from measure.geometry import skew
from measure.limits import CLEAR_RATIO, LEVER_MM
from measure.robots import SerialChain, StateSchema
from measure_learning.core.causes import changed, check_turns, explain
from measure_learning.core.clock import MIN_KEPT_SHARE
from measure_learning.core.frame_fit import (
    FrameFit,
    align_turns,
    best_stops,
    fit_frames,
    quick_miss,
)
from measure_learning.core.frame_judgement import judgement
from measure_learning.core.frames import RobotFrame
from measure_learning.core.robot_model import FRAMES, Sightings
from measure_learning.core.sightings import (
    LEAST_STOPS,
    Stops,
    at_rest,
    clock_of,
    is_sparse,
    moving,
    own_delays_s,
    rough_clock_of,
    stop_sightings,
    stops_left_out,
)
from measure_learning.core.sightings import LoggedTrack as LoggedTrack
from measure_learning.robots.links import TURNS, link_names
from measure_learning.robots.tool_poses import Angles, ToolPoses, ToolReading

_LEAST_POSES, _LEAST_S = 30, 15.0
_LEAST_WAY_MM = 20.0  # across the longest way, of a robot without known kinematics
_SAME_CLOCK_S = 2e-4
_ROUNDS = (400, 400, 3000)
"""Poses that are fitted, until the clock stays: few at first; more than the last cost much."""
_WRONG_CHAIN_MM = 5.0  # RMS left, most of it by links: no arm is built so badly
_MOST_LINK_MM = 100.0  # error of a link that a wrong table may hold; a mirrored world needs more
_MOST_APART_DEG = 15.0  # RMS of rotations; slack and slipping drives of a wrist leave less
_ALIKE_DEG = 1.0  # RMS of rotations, up to which a reading of angles may be right
_MOST_LEFT = 0.25  # share of the motion (RMS) that is left where base and tool explain nothing
_BLOCKS = ("world_from_base", "flange_from_body")
_AXES = ("x_mm", "y_mm", "z_mm", "x_rad", "y_rad", "z_rad")


@dataclass(frozen=True)
class RegisterOptions:
    """What is registered, and what is known of it.

    Attributes:
        kinematics: also fit the errors of the robot's links, each near its usual size.
        clock_offset_s: robot time minus camera time, if known; else estimated from the motion.
        largest_offset_s: search the offset within plus and minus this.
        eye_in_hand: the cameras are on the flange, and the body stands in the world.
        angles: how a log or table without joints writes the tool's rotation; else what fits best.
    """

    kinematics: bool = False
    clock_offset_s: float | None = None
    largest_offset_s: float = 5.0
    eye_in_hand: bool = False
    angles: Angles | None = None

    def __post_init__(self) -> None:
        for name in ("clock_offset_s", "largest_offset_s"):
            value = getattr(self, name)
            if value is not None and not abs(value) < 1e11:
                raise EstimatorError(f"{name} is {value:g}: expected a number of seconds")
        if self.largest_offset_s < 0:
            raise EstimatorError(
                f"largest_offset_s is {self.largest_offset_s:g}: expected a number that is not "
                "negative"
            )


def register(recordings: Sequence[LoggedTrack], options: RegisterOptions) -> RobotFrame:
    """Find world_from_base, flange_from_body and the clock of every recording, all at once.

    The flange is the point that the robot reports, turned as its kinematics say. Where these are
    not known it does not turn, and flange_from_body holds a point alone. Where poses or states are
    those of a robot that stood still, rests are matched and no clock is found. What the motion does
    not determine is named in the judgement. EstimatorError: poses without rotations, too few of
    them, clocks that do not match, kinematics that are not known or do not fit, and poses or joints
    that fit once a slip is undone, which is named. The recordings are of one robot; the cameras and
    the body stayed where they were.
    """
    schema, names = recordings[0].log.schema, [r.track.name for r in recordings]
    _refuse_unfit(recordings, options.kinematics)
    if options.eye_in_hand:
        recordings = [replace(one, track=one.track.inverted()) for one in recordings]
    given = options.clock_offset_s
    if any(is_sparse(one.track) for one in recordings):
        stops = [at_rest(one, given) for one in recordings]
        if all(stops):
            return register_stops([one for one in stops if one], schema, options)
    try:
        clocks = np.array(
            [clock_of(r, options.largest_offset_s) if given is None else given for r in recordings]
        )
        moving(recordings, clocks, given is not None, LEAST_STOPS)  # refuses a log at 1 Hz
    except EstimatorError as problem:
        stops = [at_rest(one, given) for one in recordings]
        if all(stops):
            return register_stops([one for one in stops if one], schema, options)
        raise _slip_behind(recordings, options, problem) from None
    if given is not None:
        _refuse_clock(recordings, given, options.largest_offset_s)
    for most in _ROUNDS:
        seen = moving(recordings, clocks, given is not None, most)
        _refuse_poor(seen, schema.robot)
        _refuse_turned(seen, slice(None), schema, names, options)
        fit = fit_frames(seen, kinematics=options.kinematics)
        clocks = clocks + fit.clocks_s
        whole = most >= sum(len(one.track.times_s) for one in recordings)
        if whole and np.abs(fit.clocks_s).max() < _SAME_CLOCK_S:
            break
    _refuse_slips(fit, seen, schema, options)
    slack = own_delays_s(fit, seen)
    diagonal = np.arange(FRAMES, FRAMES + len(names))
    covariance = fit.covariance.copy()
    covariance[diagonal, diagonal] += np.square(slack)
    found = replace(fit, covariance=covariance)
    return _frame(found, seen, schema, dict(zip(names, clocks.tolist(), strict=True)), options)


def register_stops(
    stops: Sequence[Stops], schema: StateSchema, options: RegisterOptions
) -> RobotFrame:
    """The same from pairs of pose and state of a robot at rest; see `register`."""
    if options.kinematics and (schema.chain is None or isinstance(schema.chain, ToolPoses)):
        raise _no_chain(schema)
    seen = stop_sightings(stops, schema)
    if len(seen.poses) < LEAST_STOPS:
        raise EstimatorError(
            f"{' and '.join(one.name for one in stops)}: {len(seen.poses)} poses with the robot's "
            f"joints: at least {LEAST_STOPS} at rest are needed, better 15, each turned by 30 deg "
            "or more against the others"
        )
    names = [one.name for one in stops]
    _refuse_turned(seen, best_stops(seen), schema, names, options)
    fit = fit_frames(seen, kinematics=options.kinematics)
    _refuse_slips(fit, seen, schema, options)
    frame = _frame(fit, seen, schema, {}, options)
    if fit.kept.all():
        return frame
    left_out = {"stops_left_out": stops_left_out(fit, seen, stops)}
    return replace(frame, judgement={**frame.judgement, **left_out})


def turns_apart_deg(one: LoggedTrack, options: RegisterOptions) -> float:
    """By how much the turns of poses and log miss each other, RMS; inf where no instants match."""
    given, schema = options.clock_offset_s, one.log.schema
    try:
        if is_sparse(one.track):
            raise EstimatorError("stops are matched by their rests")
        clock = clock_of(one, options.largest_offset_s) if given is None else given
        seen = moving([one], np.array([clock]), True, _ROUNDS[0])
    except EstimatorError:
        stops = at_rest(one, given)
        if stops is None:
            return float("inf")
        seen = stop_sightings([stops], schema)
    return _turns_apart_deg(seen)


def stops_apart_deg(stops: Stops, schema: StateSchema) -> float:
    """The same of stops."""
    return _turns_apart_deg(stop_sightings([stops], schema))


def _turns_apart_deg(seen: Sightings) -> float:
    if len(seen.poses) < LEAST_STOPS:
        return float("inf")
    seen = seen.take(best_stops(seen)) if seen.apart else seen
    turns = seen.hand().rotation, seen.poses.world_from_body.rotation
    return float(np.degrees(align_turns(*turns)[2]))


def choose_reading(
    where: str, readings: Sequence[ToolReading], apart_deg: Sequence[float]
) -> tuple[int, str]:
    """The reading of a tool's poses that brings the turns together, and a note on it.

    If none does it is the first, and the refusal that follows says why. EstimatorError: others do
    nearly as well.
    """
    best = int(np.argmin(apart_deg))
    if not apart_deg[best] < _MOST_APART_DEG:
        best = 0
    words = f"{where}: holds no joints; the tool's poses are taken, {readings[best].words}"
    others = [
        f"{reading.words}: {left:.1f} deg"
        for k, (reading, left) in enumerate(zip(readings, apart_deg, strict=True))
        if k != best
    ]
    if not others:
        return best, words
    rivals = sum(left < max(CLEAR_RATIO * apart_deg[best], _ALIKE_DEG) for left in apart_deg)
    if rivals > 1 and apart_deg[best] < _MOST_APART_DEG:
        raise EstimatorError(
            f"{where}: {readings[best].words} leaves {apart_deg[best]:.1f} deg, but "
            f"{'; '.join(others)}: say which with --angles"
        )
    return best, (
        f"{words}, which leaves {apart_deg[best]:.2f} deg of turns (RMS); {'; '.join(others)}. "
        f"--angles {readings[best].angles} states it"
    )


def _frame(
    fit: FrameFit,
    seen: Sightings,
    schema: StateSchema,
    clocks_s: dict[str, float],
    options: RegisterOptions,
) -> RobotFrame:
    kinematics = options.kinematics
    covariance, order = _in_file(fit, clocks_s, schema.chain if kinematics else None)
    return RobotFrame(
        schema.robot,
        fit.world_from_base,
        fit.body_from_flange.inverse(),
        clocks_s,
        covariance,
        order,
        judgement(fit, seen, kinematics),
        _kinematics(fit, schema.chain) if kinematics and schema.chain else None,
        eye_in_hand=options.eye_in_hand,
    )


def _refuse_unfit(recordings: Sequence[LoggedTrack], kinematics: bool) -> None:
    schema = recordings[0].log.schema
    if kinematics and (schema.chain is None or isinstance(schema.chain, ToolPoses)):
        raise _no_chain(schema)
    for one in recordings:
        if one.track.rotations is None:
            raise EstimatorError(
                f"{one.track.name}: holds positions alone; registering needs poses: give a run, or "
                "a table with qw, qx, qy, qz"
            )


def _refuse_clock(recordings: Sequence[LoggedTrack], given_s: float, largest_s: float) -> None:
    """Refuse a clock offset that is given where the one of the motion leaves far less."""
    for one in recordings:
        if one.log.schema.chain is None:
            continue
        try:
            found_s = clock_of(one, largest_s)
            left, given_left = (
                quick_miss(moving([one], np.array([at_s]), True, _ROUNDS[0]))
                for at_s in (found_s, given_s)
            )
        except EstimatorError:  # the motion shows no clock
            continue
        if given_left > max(CLEAR_RATIO * left, _WRONG_CHAIN_MM):
            raise EstimatorError(
                f"{one.track.name}: with the given clock offset of {given_s:.4g} s {given_left:.1f}"
                f" mm are left (turns at {LEVER_MM:g} mm), with {found_s:.4f} s, which the motion "
                f"shows, {left:.2f} mm: leave out --clock-offset-s, or give that"
            )


def _no_chain(schema: StateSchema) -> EstimatorError:
    if schema.chain is not None:
        return EstimatorError(
            "--kinematics: the log holds the tool's poses, and no joints whose links can be fitted"
        )
    return EstimatorError(
        f"--kinematics: those of {schema.robot} are not known: describe its joints with "
        "alpha_deg in robot.toml"
    )


def _slip_behind(
    recordings: Sequence[LoggedTrack], options: RegisterOptions, problem: EstimatorError
) -> EstimatorError:
    """What a recording is refused for whose clock no motion shows: a slip, if one explains it."""
    schema = recordings[0].log.schema
    for one in recordings:
        if schema.chain is None or (rough := rough_clock_of(one)) is None:
            continue
        try:
            seen = moving([one], np.array([rough]), False, _ROUNDS[0])
        except EstimatorError as other:
            return other
        if len(seen.poses) < LEAST_STOPS:
            continue
        if (cause := explain(seen, _joint_names(schema), options.eye_in_hand)) is not None:
            return EstimatorError(f"{one.track.name}: {cause}")
    return problem


def _joint_names(schema: StateSchema) -> list[str]:
    return [reading.terms[0][0] for reading in schema.joints]


def _refuse_poor(seen: Sightings, robot: str) -> None:
    """Name what is missing of a motion in which clocks are to be found: poses, seconds, a way."""
    span = sum(
        float(np.ptp(times)) if len(times := seen.poses.times_s[seen.recording == k]) else 0.0
        for k in range(len(seen.shared))
    )
    least, least_s = (LEAST_STOPS, 0.0) if seen.clocks_known else (_LEAST_POSES, _LEAST_S)
    if len(seen.poses) < least or span < least_s:
        raise EstimatorError(
            f"{len(seen.poses)} poses with a state of the robot over {span:.1f} s: at least "
            f"{least} over {least_s:g} s are needed: record the moving robot for longer, or let it "
            f"stand at {LEAST_STOPS} or more places (--stops)"
        )
    place = seen.reported_mm - seen.reported_mm.mean(axis=0)
    ways = 4 * np.linalg.svd(place, compute_uv=False) / np.sqrt(len(place))
    if seen.chain is None and ways[1] < _LEAST_WAY_MM:
        raise EstimatorError(
            f"the tip of {robot} moved by {ways[0]:.0f}, {ways[1]:.0f} and {ways[2]:.0f} mm along "
            f"three axes: move it by {_LEAST_WAY_MM:g} mm or more along a second one, or describe "
            "the robot's kinematics"
        )


def _refuse_turned(
    seen: Sightings,
    rows: Bools | slice,
    schema: StateSchema,
    names: Sequence[str],
    options: RegisterOptions,
) -> None:
    """Refuse `rows` whose rotations no base and tool bring together, with what explains it."""
    if seen.chain is None:
        return
    seen_turns, own_turns = (
        seen.poses.world_from_body.rotation[rows],
        seen.chain.pose(seen.joints[rows]).rotation,
    )
    try:
        check_turns(" and ".join(names), seen_turns, own_turns, most_deg=_MOST_APART_DEG)
    except EstimatorError as problem:
        cause = explain(seen, _joint_names(schema), options.eye_in_hand)
        if cause is None:
            raise
        raise EstimatorError(f"{' and '.join(names)}: {cause}") from problem


def _refuse_slips(
    fit: FrameFit, seen: Sightings, schema: StateSchema, options: RegisterOptions
) -> None:
    """Refuse what is left, if it is too much, or if one slip explains most of it."""
    alone, kept = fit.alone or fit, float(fit.kept.mean())
    left = alone.rms_mm(seen.take(fit.kept))
    places = seen.poses.world_from_body.translation
    spread = float(np.linalg.norm(places.std(axis=0)))
    if kept < MIN_KEPT_SHARE or left > max(_MOST_LEFT * spread, _WRONG_CHAIN_MM):
        if (cause := explain(seen, _joint_names(schema), options.eye_in_hand)) is not None:
            raise EstimatorError(cause)
        if left > _MOST_LEFT * spread:
            raise EstimatorError(
                f"base, tool and clock leave {left:.1f} mm RMS of a motion of {spread:.0f} mm: is "
                "--robot the right one, and is this the log of this recording?"
            )
    seen = seen.take(fit.kept)
    if (cause := changed(alone, seen)) is not None:
        raise EstimatorError(cause)
    if schema.chain and options.kinematics:
        _refuse_unlike(fit, schema.chain)
    elif schema.chain:
        _refuse_wrong(fit, seen, schema.chain)
    if kept < MIN_KEPT_SHARE:
        raise EstimatorError(
            f"{100 * (1 - kept):.0f} % of the poses are not where base and tool of the others put "
            "them: did the cameras, the base or the body move, or was another body mistaken for it?"
        )


def _refuse_unlike(fit: FrameFit, chain: SerialChain) -> None:
    """Refuse links that are fitted as no arm is built: then the poses are not of this arm."""
    lengths = np.where(np.resize(TURNS, fit.links.shape), 0.0, fit.links)
    worst = int(np.argmax(np.abs(lengths)))
    if abs(lengths[worst]) > _MOST_LINK_MM:
        raise EstimatorError(
            f"--kinematics: the motion is met with {link_names(chain)[worst]} off by "
            f"{lengths[worst]:.0f} mm: are the poses mirrored (axes of a left hand), or of another "
            "robot?"
        )


def _refuse_wrong(fit: FrameFit, seen: Sightings, chain: SerialChain) -> None:
    """Name the link that most likely makes what base, tool and clock do not explain."""
    if (left := fit.rms_mm(seen)) < _WRONG_CHAIN_MM:
        return
    bent = fit_frames(seen, kinematics=True)
    if bent.rms_mm(seen) > left / 2:  # slack, or a drive that slips
        return
    unit = np.where(np.resize(TURNS, bent.links.shape), np.deg2rad(1.0), 1.0)
    worst = int(np.argmax(np.abs(bent.links) / np.where(unit < 1, unit, 5.0)))
    value = f"{link_names(chain)[worst]} off by {bent.links[worst] / unit[worst]:.1f}"
    raise EstimatorError(
        f"base, tool and clock leave {left:.1f} mm RMS of the robot's motion, "
        f"{bent.rms_mm(seen):.2f} mm with {value} and others by less: the kinematics are wrong; "
        "correct alpha_deg, a_mm, offset_deg or d_mm there, or fit them with --kinematics"
    )


def _in_file(
    fit: FrameFit, names: Sequence[str] | dict[str, float], chain: SerialChain | None
) -> tuple[Floats, tuple[str, ...]]:
    """Covariance of world_from_base, flange_from_body, clocks and links, and its order."""
    J, turn = np.eye(len(fit.covariance)), fit.body_from_flange.rotation.T
    J[6:FRAMES, 6:FRAMES] = np.kron(np.eye(2), -turn)  # as in UncertainTransform.inverse
    J[6:9, 9:FRAMES] = -turn @ skew(fit.body_from_flange.translation)
    if not names:  # stops: no clock was found
        J = np.delete(J, np.arange(FRAMES, FRAMES + len(fit.clocks_s)), axis=0)
    frames = [f"{block}.{axis}" for block in _BLOCKS for axis in _AXES]
    links = [] if chain is None else [n.replace("_deg", "_rad") for n in link_names(chain)]
    order = (*frames, *(f"clock_offset_s.{name}" for name in names), *links)
    return J @ fit.covariance @ J.T, order


def _kinematics(fit: FrameFit, chain: SerialChain) -> dict[str, Any]:
    """Errors of the links, with their standard deviations, in mm and deg."""
    size = len(fit.links)
    scale = np.where(np.resize(TURNS, size), np.degrees(1.0), 1.0)
    sd = np.sqrt(np.diag(fit.covariance))[-size:]
    return {
        "parameters": list(link_names(chain)),
        "values": fit.links * scale,
        "sd": sd * scale,
        "sd_before": fit.link_sd * scale,
    }

"""A robot registered to the cameras: its base, the body on its tool, and the clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform, skew
from measure.metrology.poses import PoseTable, SharedErrors
from measure.robots import SerialChain
from measure.robots.chain import TURNS, link_names
from measure_learning.core.assemble import PoseTrack, complete_states, interpolate
from measure_learning.core.clock import estimate_offset
from measure_learning.core.frame_fit import FRAMES, FrameFit, Sightings, fit_frames
from measure_learning.core.frames import RobotFrame
from measure_learning.core.labels import chain_doubt, check_turns
from measure_learning.robots import StateLog

_LEAST_POSES, _LEAST_S = 30, 15.0
_LEAST_TURN_DEG = 15.0  # about a second axis: turns about one alone leave a shift along it open
_LEAST_WAY_MM = 20.0  # across the longest way, of a robot without known kinematics
_MOST_POSES = 3000  # more add little, and cost much
_LONGEST_GAP_S, _RATE_STEP_S = 0.05, 0.01
_PATH_MM_PER_RAD = 100.0
_SAME_CLOCK_S, _ROUNDS = 2e-4, 3
_WRONG_CHAIN_MM = 5.0  # RMS left, most of it by links: no arm is built so badly
_MOST_LINK_MM = 100.0  # error of a link that a wrong table may hold; a mirrored world needs more
_MOST_APART_DEG = 15.0  # RMS of rotations; slack and slipping drives of a wrist leave less
_WEAK_MM, _WEAK_RAD = 2.0, float(np.deg2rad(0.3))  # SD from which a frame is told to be uncertain
_NOT_SHOWN = 0.7  # share of its SD that a link's error keeps if the motion does not show it
_BLOCKS = ("world_from_base", "flange_from_body")
_AXES = ("x_mm", "y_mm", "z_mm", "x_rad", "y_rad", "z_rad")


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of the body on the tool, and the robot's log."""

    track: PoseTrack
    log: StateLog
    shared: SharedErrors | None = None  # what the poses err by together, if that is known


@dataclass(frozen=True)
class RegisterOptions:
    """What is registered, and what is known of it.

    Attributes:
        kinematics: also fit the errors of the robot's links, each near its usual size.
        clock_offset_s: robot time minus camera time, if known; else estimated from the motion.
        largest_offset_s: search the offset within plus and minus this.
    """

    kinematics: bool = False
    clock_offset_s: float | None = None
    largest_offset_s: float = 5.0


def register(recordings: Sequence[Recording], options: RegisterOptions) -> RobotFrame:
    """Find world_from_base, flange_from_body and the clock of every recording, all at once.

    The flange is the point that the robot reports, turned as its kinematics say. Where these are
    not known it does not turn, and flange_from_body holds a point alone. EstimatorError: poses
    without rotations, a motion that shows too little, clocks that do not match, kinematics that are
    not known or do not fit. The recordings are of one robot; the cameras and the body stayed where
    they were.
    """
    clock_offset_s, kinematics = options.clock_offset_s, options.kinematics
    schema, given = recordings[0].log.schema, clock_offset_s is not None
    names = [r.track.name for r in recordings]
    _refuse_unfit(recordings, kinematics)
    clocks = np.array(
        [
            _clock(r, options.largest_offset_s) if clock_offset_s is None else clock_offset_s
            for r in recordings
        ]
    )
    for _ in range(_ROUNDS):
        seen = _sightings(recordings, clocks, given)
        _refuse_poor(seen, schema.robot)
        if seen.chain:
            turns = seen.poses.world_from_body.rotation, seen.chain.pose(seen.joints).rotation
            check_turns(" and ".join(names), *turns, most_deg=_MOST_APART_DEG)
        fit = fit_frames(seen, kinematics=kinematics)
        clocks = clocks + fit.clocks_s
        if np.abs(fit.clocks_s).max() < _SAME_CLOCK_S:
            break
    if schema.chain and kinematics:
        _refuse_unlike(fit, schema.chain)
    elif schema.chain:
        _refuse_wrong(fit, seen, schema.chain)
    covariance, order = _in_file(fit, names, schema.chain if kinematics else None)
    return RobotFrame(
        schema.robot,
        fit.world_from_base,
        fit.body_from_flange.inverse(),
        dict(zip(names, clocks.tolist(), strict=True)),
        covariance,
        order,
        _judgement(fit, seen, kinematics),
        _kinematics(fit, schema.chain) if kinematics and schema.chain else None,
    )


def _refuse_unfit(recordings: Sequence[Recording], kinematics: bool) -> None:
    schema = recordings[0].log.schema
    if kinematics and schema.chain is None:
        raise EstimatorError(
            f"--kinematics: those of {schema.robot} are not known: describe its joints with "
            "alpha_deg in robot.toml"
        )
    for one in recordings:
        if one.track.rotations is None:
            raise EstimatorError(
                f"{one.track.name}: holds positions alone; registering needs poses: give a run, or "
                "a table with qw, qx, qy, qz"
            )


def _clock(one: Recording, largest_s: float) -> float:
    """By the turns, which are the same wherever on the tool the body is; else by the places."""
    track, log, chain = one.track.measured(), one.log, one.log.schema.chain
    assert track.rotations is not None
    complete_states(track.name, log)  # refuses a log without any
    first, last = track.times_s[[0, -1]] + (-2 * largest_s, 2 * largest_s)
    rows = np.flatnonzero((log.times_s > first) & (log.times_s < last) & log.complete)
    if chain is not None and len(rows) > 1:
        turned = chain.pose(log.schema.joint_positions(log.states_at(rows))).rotation
        paths = (_turning_path(track.rotations), log.times_s[rows], _turning_path(turned))
        try:
            return estimate_offset(track.times_s, *paths, largest_s=largest_s).offset_s
        except EstimatorError:  # the wrist hardly turned, or its encoders slip
            pass
    robot = log.times_s[log.complete], log.reported_mm[log.complete]
    places = track.positions_mm
    return estimate_offset(track.times_s, places, *robot, largest_s=largest_s).offset_s


def _turning_path(rotations: Floats) -> Floats:
    """A path (n, 3) whose velocity is the angular velocity, along the axes of the target frame."""
    steps = RigidTransform(rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2), np.zeros(3)).rotvec
    return _PATH_MM_PER_RAD * np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _sightings(recordings: Sequence[Recording], clocks_s: Floats, given: bool) -> Sightings:
    """Poses and states of the same instants; poses without a state near in time are left out."""
    schema = recordings[0].log.schema
    measured = [r.track.measured() for r in recordings]
    every = -(-sum(len(track.times_s) for track in measured) // _MOST_POSES)
    rows = []
    for k, (one, track) in enumerate(zip(recordings, measured, strict=True)):
        table = track.table().take(slice(None, None, every))
        at = table.times_s + clocks_s[k]
        around = (at + _RATE_STEP_S * np.array([[0.0], [1.0], [-1.0]])).ravel()
        states, near = interpolate(complete_states(track.name, one.log), around, _LONGEST_GAP_S)
        states, ahead, behind = states.reshape(3, len(at), -1)
        usable = np.asarray(near.reshape(3, -1).all(axis=0))
        read = schema.joint_positions if schema.chain else schema.position_mm
        rates = (read(ahead) - read(behind)) / (2 * _RATE_STEP_S)
        place, joints = schema.position_mm(states), schema.joint_positions(states)
        if (doubt := chain_doubt(schema.chain, joints[usable], place[usable])) is not None:
            raise EstimatorError(f"{track.name}: {doubt}")
        P = table.world_from_body
        index = np.full(len(at), k)
        columns = (table.times_s, index, P.rotation, P.translation, table.covariances)
        rows.append([column[usable] for column in (*columns, place, joints, rates)])
    times, index, turn, shift, covariances, place, joints, rates = map(
        np.concatenate, zip(*rows, strict=True)
    )
    poses = PoseTable(times, RigidTransform(turn, shift), covariances)
    shared = tuple(r.shared for r in recordings)
    return Sightings(poses, index, place, joints, rates, schema.chain, shared, given)


def _refuse_poor(seen: Sightings, robot: str) -> None:
    """Name what is missing of a motion that does not show base and tool: poses, seconds, turns."""
    span = sum(
        float(np.ptp(times)) if len(times := seen.poses.times_s[seen.recording == k]) else 0.0
        for k in range(len(seen.shared))
    )
    if len(seen.poses) < _LEAST_POSES or span < _LEAST_S:
        raise EstimatorError(
            f"{len(seen.poses)} poses with a state of the robot over {span:.1f} s: at least "
            f"{_LEAST_POSES} over {_LEAST_S:g} s are needed: record the moving robot for longer"
        )
    flange = seen.flange(np.zeros(seen.links), np.zeros(len(seen.shared)))[0]
    turned, axes = _turned_deg(
        flange.rotation if seen.chain else seen.poses.world_from_body.rotation
    )
    if turned[1] < _LEAST_TURN_DEG:
        x, y, z = axes[:, 1]
        raise EstimatorError(
            f"the tool was turned by {turned[0]:.0f} deg about one axis, and across it by "
            f"{turned[1]:.0f} and {turned[2]:.0f} deg: base and tool cannot be told apart; turn "
            f"it by {_LEAST_TURN_DEG:g} deg or more about a second axis, such as ({x:.2f}, "
            f"{y:.2f}, {z:.2f}) of the {'flange' if seen.chain else 'body'}"
        )
    place = seen.reported_mm - seen.reported_mm.mean(axis=0)
    ways = 4 * np.linalg.svd(place, compute_uv=False) / np.sqrt(len(place))
    if seen.chain is None and ways[1] < _LEAST_WAY_MM:
        raise EstimatorError(
            f"the tip of {robot} moved by {ways[0]:.0f}, {ways[1]:.0f} and {ways[2]:.0f} mm along "
            f"three axes: move it by {_LEAST_WAY_MM:g} mm or more along a second one, or describe "
            "the robot's kinematics"
        )


def _turned_deg(rotations: Floats) -> tuple[Floats, Floats]:
    """How far something was turned about its principal axes (3,), and these as columns."""
    u, _, v = np.linalg.svd(rotations.sum(axis=0))
    middle = u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))] @ v
    turns = RigidTransform(middle.T @ rotations, np.zeros(3)).rotvec
    axes = np.linalg.svd(turns - turns.mean(axis=0), full_matrices=False)[2].T
    low, high = np.percentile(turns @ axes, (1, 99), axis=0)
    return np.degrees(high - low), axes


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
    fit: FrameFit, names: Sequence[str], chain: SerialChain | None
) -> tuple[Floats, tuple[str, ...]]:
    """Covariance of world_from_base, flange_from_body, clocks and links, and its order."""
    J, turn = np.eye(len(fit.covariance)), fit.body_from_flange.rotation.T
    J[6:FRAMES, 6:FRAMES] = np.kron(np.eye(2), -turn)  # as in UncertainTransform.inverse
    J[6:9, 9:FRAMES] = -turn @ skew(fit.body_from_flange.translation)
    frames = [f"{block}.{axis}" for block in _BLOCKS for axis in _AXES]
    links = [] if chain is None else [n.replace("_deg", "_rad") for n in link_names(chain)]
    order = (*frames, *(f"clock_offset_s.{name}" for name in names), *links)
    return J @ fit.covariance @ J.T, order


def _judgement(fit: FrameFit, seen: Sightings, kinematics: bool) -> dict[str, Any]:
    ends = np.sqrt(np.trace(seen.poses.covariances[:, :3, :3], axis1=1, axis2=2))
    return {
        "poses": len(seen.poses),
        "rms_mm": fit.rms_mm(seen),
        "held_out_rms_mm": _held_out(seen, kinematics),
        "stated_noise_mm": float(np.sqrt(np.mean(ends**2))),
        "not_separable": _not_separable(fit, seen, kinematics),
    }


def _held_out(seen: Sightings, kinematics: bool) -> float:
    """RMS of what halves in time leave of each other, mm; NaN if a half shows too little."""
    times, squares = seen.poses.times_s, []
    middle = [np.median(times[seen.recording == k]) for k in range(len(seen.shared))]
    late = times > np.array(middle)[seen.recording]
    for half in (late, ~late):
        if _turned_deg(seen.poses.world_from_body.rotation[half])[0][1] < _LEAST_TURN_DEG / 3:
            return float("nan")
        fit = fit_frames(seen.take(half), kinematics=kinematics)
        squares.append(fit.rms_mm(seen.take(~half)) ** 2)
    return float(np.sqrt(np.mean(squares)))


def _not_separable(fit: FrameFit, seen: Sightings, kinematics: bool) -> list[str]:
    """What remains uncertain of the frames, and why, in sentences."""
    said = []
    if seen.chain is None:
        said.append("how the flange is turned: the robot's kinematics are not known")
    sd = np.sqrt(np.diag(fit.covariance))
    for block, start in (("world_from_base", 0), ("body_from_flange", 6)):
        place, turn = sd[start : start + 3], sd[start + 3 : start + 6]
        if seen.chain is None and start:
            turn = np.zeros(3)
        if np.linalg.norm(place) < _WEAK_MM and np.linalg.norm(turn) < _WEAK_RAD:
            continue
        known = f"{block} is known to {np.linalg.norm(place):.1f} mm and "
        known += f"{np.degrees(np.linalg.norm(turn)):.2f} deg (SD, 3-D)"
        said.append(f"{known}: {_reason(fit, start)}")
    if kinematics and seen.chain:
        kept = sd[-seen.links :] / fit.link_sd > _NOT_SHOWN
        names = np.array(link_names(seen.chain))[kept]
        if len(names):
            said.append(f"not shown by this motion: {', '.join(names)}")
    return said


def _reason(fit: FrameFit, start: int) -> str:
    """Why six parameters are uncertain: constant errors of joints, or too little motion."""
    rows = slice(start, start + 6)
    scale = np.diag(fit.covariance)[rows]
    by_joint = (fit.frames_by_links[rows] ** 2 / scale[:, None]).reshape(6, -1, 6).sum(axis=(0, 2))
    if by_joint.sum() < 3.0:  # of six: less than half of the variance
        return "this motion shows no more; turn and move the tool further"
    first = np.argsort(-by_joint)[: max(1, int(np.sum(by_joint > by_joint.max() / 3)))]
    joints = ", ".join(str(k + 1) for k in sorted(first))
    what = "base" if start == 0 else "tool"
    return (
        f"constant errors of joints {joints} move the tip as another {what} would, and cannot be "
        f"separated from it: labels are relative to the fitted {what}; else measure it by markers"
    )


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

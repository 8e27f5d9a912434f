"""Poses of a body on a robot's tool, and what the robot reports at their instants: moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.limits import LEVER_MM
from measure.metrology.poses import PoseTable, SharedErrors
from measure.robots import SerialChain
from measure_learning.core.assemble import (
    LONGEST_GAP_S,
    PoseTrack,
    check_rate,
    complete_states,
    interpolate,
)
from measure_learning.core.clock import MAX_SEARCHED_S, SLOPE_S, estimate_offset, rough_offset
from measure_learning.core.frame_fit import FRAMES, FrameFit, LinearModel, Sightings
from measure_learning.core.labels import chain_doubt
from measure_learning.robots import StateLog

_ALIKE_S, _DELAY_RATIO = 0.1, 2.0
_LEAST_EXPLAINED = 0.3  # share of a motion's variance that joints of other signs and order explain


@dataclass(frozen=True, eq=False)
class LoggedTrack:
    """Poses of the body on the tool, and the robot's log."""

    track: PoseTrack
    log: StateLog
    shared: SharedErrors | None = None  # what the poses err by together, if that is known


def clock_of(one: LoggedTrack, largest_s: float) -> float:
    """By the turns, which are the same wherever on the tool the body is; else by the places."""
    track, log, chain = one.track.measured(), one.log, one.log.schema.chain
    assert track.rotations is not None
    complete_states(track.name, log)  # refuses a log without any
    paths = [(track.positions_mm, log.times_s[log.complete], log.reported_mm[log.complete])]
    if chain is not None:
        times, joints = _joints(one)
        turned = chain.pose(joints).rotation
        paths.insert(0, (_turning_path(track.rotations), times, _turning_path(turned)))
    whole_s = min(float(np.ptp(track.times_s) + np.ptp(log.times_s)), MAX_SEARCHED_S / 2)
    start_s = log.times_s[0] - track.times_s[0]
    problem = None
    for shift_s, within_s in ((0.0, largest_s), (start_s, whole_s)):
        for measured, times, reported in paths:
            try:
                found = estimate_offset(
                    track.times_s, measured, times - shift_s, reported, largest_s=within_s
                )
            except EstimatorError as reason:  # the wrist hardly turned, or its encoders slip
                problem = problem if shift_s else reason
            else:
                return found.offset_s + shift_s
    assert problem is not None
    raise problem


def rough_clock_of(one: LoggedTrack) -> float | None:
    """The offset by motion alone, whatever the joints' order and signs and the poses' axes."""
    track = one.track.measured()
    assert track.rotations is not None
    times, joints = _joints(one)
    if len(times) < 2 or len(track.times_s) < 2:
        return None
    dt, turn = np.diff(track.times_s)[:, None], track.rotations
    steps = np.swapaxes(turn[:-1], 1, 2) @ turn[1:]
    spins = RigidTransform(steps, np.zeros(3)).rotvec / dt
    moves = np.einsum("nji,nj->ni", turn[:-1], np.diff(track.positions_mm, axis=0) / dt)
    rates = np.diff(joints, axis=0) / np.diff(times)[:, None]
    at = (track.times_s[1:] + track.times_s[:-1]) / 2, (times[1:] + times[:-1]) / 2
    twists = np.concatenate([spins, moves], axis=1)
    offset, explained = rough_offset(at[0], twists, at[1], rates)
    return offset if explained > _LEAST_EXPLAINED else None


def _joints(one: LoggedTrack) -> tuple[Floats, Floats]:
    """Times (n,) and joints (n, joints) of a log, angles without jumps by a turn."""
    log = one.log
    rows = np.flatnonzero(log.complete)
    joints = log.schema.joint_positions(log.states_at(rows))
    chain = log.schema.chain
    for k, joint in enumerate(chain.joints if chain else ()):
        if not joint.prismatic:
            joints[:, k] = np.unwrap(joints[:, k])
    return log.times_s[rows], joints


def _turning_path(rotations: Floats) -> Floats:
    """A path (n, 3) whose velocity is the angular velocity, along the axes of the target frame."""
    steps = RigidTransform(rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2), np.zeros(3)).rotvec
    return LEVER_MM * np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def moving(
    recordings: Sequence[LoggedTrack], clocks_s: Floats, given: bool, most: int
) -> Sightings:
    """Poses and states of the same instants; poses without a state near in time are left out."""
    schema = recordings[0].log.schema
    measured = [r.track.measured() for r in recordings]
    every = -(-sum(len(track.times_s) for track in measured) // most)
    rows = []
    for k, (one, track) in enumerate(zip(recordings, measured, strict=True)):
        table = track.table().take(slice(None, None, every))
        at = table.times_s + clocks_s[k]
        around = (at + SLOPE_S * np.array([[0.0], [1.0], [-1.0]])).ravel()
        log = complete_states(track.name, one.log)
        check_rate(track.name, log)
        states, near = interpolate(log, around, LONGEST_GAP_S)
        states, ahead, behind = states.reshape(3, len(at), -1)
        usable = np.asarray(near.reshape(3, -1).all(axis=0))
        read = schema.joint_positions if schema.chain else schema.position_mm
        rates = _without_turns(schema.chain, read(ahead) - read(behind)) / (2 * SLOPE_S)
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


def _without_turns(chain: SerialChain | None, steps: Floats) -> Floats:
    """Changes (n, joints) of the joints, without whole turns."""
    if chain is None:
        return steps
    turning = np.array([not joint.prismatic for joint in chain.joints])
    whole = np.round(steps / (2 * np.pi)) * 2 * np.pi
    return np.where(turning, steps - whole, steps)


def own_delays_s(fit: FrameFit, seen: Sightings) -> Floats:
    """SD (recordings,) of the delays of slack and soft gears, which look like a clock's.

    By what is left of the motion once links are fitted too. Slack errs as a square wave does where
    the motion is a sine: the part that looks like a delay is twice what is left of it. Poses some
    time apart share what the robot does, and no noise.
    """
    best = fit.bent or fit
    seen = seen.take(fit.kept)
    near = LinearModel.of(best, seen)
    r, out = near.residuals[:, :3], np.zeros(len(seen.shared))
    for k in range(len(out)):
        rows = np.flatnonzero(seen.recording == k)
        steps = np.diff(seen.poses.times_s[rows])
        apart = max(1, round(_ALIKE_S / float(np.median(steps)))) if len(steps) else 1
        if len(rows) <= apart:
            continue
        common = float(np.sum(r[rows[apart:]] * r[rows[:-apart]])) / (len(rows) - apart)
        speed = float(np.mean(np.sum(near.slopes[rows, :3, FRAMES + k] ** 2, axis=1)))
        out[k] = _DELAY_RATIO * np.sqrt(max(common, 0.0) / max(speed, 1e-12))
    return out

"""Poses of a body on a robot's tool, and what the robot reports at their instants: moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from measure.arrays import Floats, Ints
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.limits import LEVER_MM
from measure.metrology.poses import PoseTable, SharedErrors
from measure.metrology.rests import SHORTEST_S, find_rests
from measure.model import Ball, BallColor, Body
from measure.robots import SerialChain, StateSchema
from measure_learning.core.assemble import (
    LONGEST_GAP_S,
    PoseTrack,
    check_rate,
    complete_states,
    interpolate,
    unwrapped,
)
from measure_learning.core.causes import chain_doubt
from measure_learning.core.clock import (
    MAX_SEARCHED_S,
    SLOPE_S,
    SPARSE_S,
    estimate_offset,
    rough_offset,
)
from measure_learning.core.frame_fit import FrameFit, agree, align_turns
from measure_learning.core.robot_model import LinearModel, Sightings
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
    joints, chain = log.schema.joint_positions(log.states_at(rows)), log.schema.chain
    return log.times_s[rows], unwrapped(chain, joints) if chain else joints


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
        speed = float(np.mean(np.sum(near.blocks["delay"][rows, :3, k] ** 2, axis=1)))
        out[k] = _DELAY_RATIO * np.sqrt(max(common, 0.0) / max(speed, 1e-12))
    return out


LEAST_STOPS = 8
_STILL_MM = 0.3  # way of the tip, and of a point 100 mm from it, over half a second
_SAME_S = 0.3  # between the instants of one stop on two clocks that are brought together
_MOST_OFFSETS = 12  # of those that match most stops are compared by their geometry


@dataclass(frozen=True, eq=False)
class Stops:
    """Poses and states of a robot at rest, in pairs."""

    name: str
    poses: PoseTable  # n
    states: Floats  # (n, features)
    called: tuple[str, ...]  # n, for messages
    shared: SharedErrors | None = None


@dataclass(frozen=True, eq=False)
class _RestSpans:
    """Intervals in which something stands still."""

    start_s: Floats  # (n,)
    end_s: Floats


def pairs_in_table(track: PoseTrack, states: Floats) -> Stops:
    """Stops of a table that holds pose and joints in one row."""
    good = np.isfinite(track.positions_mm).all(axis=1) & np.isfinite(states).all(axis=1)
    if track.rotations is None:
        raise EstimatorError(
            f"{track.name}: holds positions alone; registering needs poses: a table with qw, qx, "
            "qy, qz"
        )
    called = tuple(f"stop {row + 1}" for row in np.flatnonzero(good))
    return Stops(track.name, track.table().take(good), states[good], called)


def at_rest(one: LoggedTrack, clock_offset_s: float | None) -> Stops | None:
    """The stops of a recording, matched by their rests; None if these are not enough."""
    track, log = one.track.measured(), one.log
    if len(track.times_s) < LEAST_STOPS or log.complete.sum() < LEAST_STOPS:
        return None
    poses, ours = _body_rests(track, one.shared)
    states, theirs = _robot_rests(one)
    pairs = _matched(poses, ours, log.schema, states, theirs, clock_offset_s)
    if len(pairs) < LEAST_STOPS:
        return None
    poses = poses.take(pairs[:, 0])
    called = tuple(f"the stop at {time_s:.1f} s" for time_s in poses.times_s)
    return Stops(track.name, poses, states[pairs[:, 1]], called, one.shared)


def is_sparse(track: PoseTrack) -> bool:
    """Whether poses are so far apart in time that they show places and no motion."""
    steps = np.diff(track.measured().times_s)
    return len(steps) > 0 and float(np.median(steps)) > SPARSE_S


def stop_sightings(stops: Sequence[Stops], schema: StateSchema) -> Sightings:
    """As the fit takes them: no joint moves, and no clock is asked for."""
    states = np.concatenate([one.states for one in stops])
    tables = [one.poses for one in stops]
    turns = np.concatenate([table.world_from_body.rotation for table in tables])
    places = np.concatenate([table.world_from_body.translation for table in tables])
    covariances = np.concatenate([table.covariances for table in tables])
    joints, place = schema.joint_positions(states), schema.position_mm(states)
    index = np.concatenate([np.full(len(one.states), k) for k, one in enumerate(stops)])
    return Sightings(
        PoseTable(
            np.arange(len(states), dtype=np.float64), RigidTransform(turns, places), covariances
        ),
        index,
        place,
        joints,
        np.zeros_like(joints if schema.chain else place),
        schema.chain,
        tuple(one.shared for one in stops),
        clocks_known=True,
        apart=True,
    )


def stops_left_out(fit: FrameFit, seen: Sightings, stops: Sequence[Stops]) -> list[str]:
    """What is wrong with the stops that a fit left out, a sentence each."""
    several = len(stops) > 1
    called = [f"{one.name}: {name}" if several else name for one in stops for name in one.called]
    out, residuals = np.flatnonzero(~fit.kept).tolist(), fit.residuals(seen)
    belongs = dict[int, str]()
    for other, name in enumerate(called):
        order = np.arange(len(called))
        order[out] = other
        fits = agree(fit, replace(seen, poses=seen.poses.take(order)), fit.kept)
        belongs |= {a: name for a in out if a != other and fits[a]}
    sentences = []
    for a in out:
        off_mm = np.linalg.norm(residuals[a, :3])
        turned = f" and {np.degrees(np.linalg.norm(residuals[a, 3:])):.1f} deg"
        cause = f"it is {off_mm:.1f} mm{turned if seen.chain else ''} off the others"
        if a in belongs:
            cause = f"the pose of its joints is that of {belongs[a]}"
        sentences.append(f"{called[a]} is left out: {cause}")
    return sentences


def _body_rests(track: PoseTrack, shared: SharedErrors | None) -> tuple[PoseTable, _RestSpans]:
    """Mean poses of the body's rests; every pose is one if they are far apart in time."""
    table = track.table()
    if float(np.median(np.diff(track.times_s))) > SPARSE_S:
        return table, _RestSpans(table.times_s, table.times_s)
    found = find_rests(table, shared or SharedErrors((), _ANY_BODY), SHORTEST_S).rests
    ends = np.array([(rest.start_s, rest.end_s) for rest in found]).reshape(-1, 2)
    places = [rest.world_from_body for rest in found]
    poses = RigidTransform(
        np.array([place.rotation for place in places]).reshape(-1, 3, 3),
        np.array([place.translation for place in places]).reshape(-1, 3),
    )
    covariances = np.array([rest.noise + rest.light for rest in found]).reshape(-1, 6, 6)
    return PoseTable(ends.mean(axis=1), poses, covariances), _RestSpans(*ends.T)


_ANY_BODY = Body(
    "any",
    tuple(
        Ball(name, BallColor.named("red"), np.array(place), 20.0)
        for name, place in zip("abc", ((38.0, 0, 0), (0, 38.0, 0), (-38.0, 0, 0)), strict=True)
    ),
    radius_tolerance_mm=0.0,
)
"""Of poses in a table: where its balls are matters for how far the light reaches alone."""


def _robot_rests(one: LoggedTrack) -> tuple[Floats, _RestSpans]:
    """States (n, features) of the robot's rests; every state is one if they are far apart."""
    log = one.log
    rows = np.flatnonzero(log.complete)
    times, states = log.times_s[rows], log.states_at(rows)
    places = _far_points(log.schema, states)
    ahead = np.minimum(np.searchsorted(times, times + SHORTEST_S, side="right") - 1, len(times) - 1)
    step = float(np.median(np.diff(times)))
    if step > SPARSE_S:
        ahead = np.minimum(np.arange(len(times)) + 1, len(times) - 1)
    still = np.abs(places[ahead] - places).max(axis=1) < _STILL_MM
    still &= times[ahead] - times > 0.8 * min(SHORTEST_S, step) if step <= SPARSE_S else True
    starts = np.flatnonzero(still & ~np.concatenate([[False], still[:-1]]))
    ends = np.flatnonzero(still & ~np.concatenate([still[1:], [False]]))
    if step > SPARSE_S and len(starts) < LEAST_STOPS:  # a state a stop
        return states, _RestSpans(times, times)
    stops = [np.median(states[a : ahead[b] + 1], axis=0) for a, b in zip(starts, ends, strict=True)]
    return np.array(stops).reshape(-1, states.shape[1]), _RestSpans(
        times[starts], times[ahead[ends]]
    )


def _far_points(schema: StateSchema, states: Floats) -> Floats:
    """The tip and points 100 mm from it, (n, 12): they move if anything of the tool does."""
    place = schema.position_mm(states)
    if schema.chain is None:
        return place
    turns = schema.chain.pose(schema.joint_positions(states)).rotation
    return np.concatenate([place, (place[:, None] + LEVER_MM * turns).reshape(len(place), 9)], 1)


def _matched(
    poses: PoseTable,
    ours: _RestSpans,
    schema: StateSchema,
    states: Floats,
    theirs: _RestSpans,
    clock_offset_s: float | None,
) -> Ints:
    """Pairs (n, 2) of the body's and the robot's rests that are the same.

    Of the clock offsets that bring most together, the one whose turns fit; or one after the other.
    """
    few = min(len(poses), len(states))
    if few < LEAST_STOPS:
        return np.zeros((0, 2), dtype=np.int64)
    offsets = (theirs.start_s[None] - ours.start_s[:, None]).ravel()
    if clock_offset_s is not None:
        offsets = np.array([clock_offset_s])
    elif not np.array_equal(theirs.start_s, theirs.end_s):
        offsets = np.concatenate([offsets, (theirs.end_s[None] - ours.end_s[:, None]).ravel()])
    counts = np.array([len(_together(ours, theirs, offset)) for offset in offsets])
    best = offsets[np.argsort(-counts, kind="stable")[:_MOST_OFFSETS]]
    options = [_together(ours, theirs, offset) for offset in best]
    if len(poses) == len(states):
        options.append(np.column_stack([np.arange(few)] * 2))
    options = [pairs for pairs in options if len(pairs) >= max(LEAST_STOPS, few // 2)]
    by_turns = partial(_misfit, poses, schema, states)
    return min(options, key=by_turns, default=np.zeros((0, 2), dtype=np.int64))


def _together(ours: _RestSpans, theirs: _RestSpans, offset_s: float) -> Ints:
    """Pairs (n, 2) of rests that overlap at an offset, each with the one nearest to it."""
    middle = (ours.start_s + ours.end_s) / 2 + offset_s
    early = theirs.start_s[None] - middle[:, None]
    late = middle[:, None] - theirs.end_s[None]
    off = np.maximum(np.maximum(early, late), 0.0)
    nearest = off.argmin(axis=1)
    rows = np.flatnonzero(off[np.arange(len(off)), nearest] <= _SAME_S)
    _, first = np.unique(nearest[rows], return_index=True)
    return np.column_stack([rows[first], nearest[rows[first]]])


def _misfit(
    poses: PoseTable, schema: StateSchema, states: Floats, pairs: Ints
) -> tuple[float, int]:
    """By how much the turns of matched stops miss each other, deg; and how many are left out."""
    if schema.chain is None:
        return 0.0, -len(pairs)
    turns = schema.chain.pose(schema.joint_positions(states[pairs[:, 1]])).rotation
    apart = align_turns(turns, poses.world_from_body.rotation[pairs[:, 0]])[2]
    return max(float(np.degrees(apart)), 1.0), -len(pairs)

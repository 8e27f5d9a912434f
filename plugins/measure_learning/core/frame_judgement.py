"""The verdict on registered frames: what is left, what stays open, which pose would help."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.geometry.covariance import posterior_covariance
from measure.metrology.poses import PoseTable
from measure_learning.core.frame_fit import FrameFit, fit_frames, nearest_rotation, precision
from measure_learning.core.robot_model import FRAMES, LinearModel, Sightings
from measure_learning.robots.links import link_names
from measure_learning.robots.tool_poses import ToolPoses

_LEAST_TURN_DEG = 5.0  # about a second axis, for a half of the poses to be judged by the other
_WEAK_MM, _WEAK_RAD = 2.0, float(np.deg2rad(0.3))  # SD from which a frame is reported as uncertain
_NOT_SHOWN = 0.7  # share of its SD that a link's error keeps if the motion does not show it
_STILL_RAD, _STILL_MM = float(np.deg2rad(0.2)), 0.2  # range of a joint that stands still
_MOST_HELD_OUT, _LEAST_HELD_OUT_MM = 2.5, 1.0
"""Times what is expected, from which poses held out refuse a frame, and at least so many mm."""
_MOST_HALF = 1000  # poses of a half: more tell no better
_ROBOTS_OWN = 100.0  # variance of a mean of poses over what they state, from which robots make it
_NO_HELP = 0.9  # ratio of SDs, from which one more pose does not help a recorded motion
_PURE = 0.02  # share of a turn in a direction that is a shift (rad of 2, mm of 1000)


def judgement(fit: FrameFit, seen: Sightings, kinematics: bool) -> dict[str, Any]:
    """The judgement that a frame's file holds, of the poses that were not left out."""
    left_out = int(np.sum(~fit.kept))
    seen = seen.take(fit.kept)
    ends = np.sqrt(np.trace(seen.poses.covariances[:, :3, :3], axis1=1, axis2=2))
    held_out, expected = _held_out(seen, kinematics)
    helps = None if isinstance(seen.chain, ToolPoses) else next_pose(fit, seen)
    if helps and not seen.apart and min(helps["base_sd_ratio"], helps["tool_sd_ratio"]) > _NO_HELP:
        helps = None
    if held_out > max(_MOST_HELD_OUT * expected, _LEAST_HELD_OUT_MM):
        raise EstimatorError(
            f"halves of the poses leave {held_out:.2f} mm of each other, where {expected:.2f} mm "
            f"are to be expected and {fit.rms_mm(seen):.2f} mm are left of all together: something "
            "has changed on the way (cameras, base, the body on the tool, a joint that slipped): "
            "register shorter stretches"
        )
    return {
        "poses": len(seen.poses),
        "left_out": left_out,
        "rms_mm": fit.rms_mm(seen),
        "held_out_rms_mm": held_out,
        "held_out_expected_mm": expected,
        "stated_noise_mm": float(np.sqrt(np.mean(ends**2))),
        "not_separable": _not_separable(fit, seen, kinematics),
        **({} if helps is None else {"next_pose": helps}),
    }


def _held_out(seen: Sightings, kinematics: bool) -> tuple[float, float]:
    """RMS of what halves leave of each other, mm, and what their SDs let expect.

    Halves in time; of stops every other one. NaN if a half shows too little.
    """
    every = slice(None, None, -(-len(seen.poses) // (2 * _MOST_HALF)))
    seen = seen.take(np.arange(len(seen.poses))[every])
    times, squares, expected = seen.poses.times_s, [], []
    if seen.apart:
        late = np.arange(len(times)) % 2 == 1
    else:
        middle = [np.median(times[seen.recording == k]) for k in range(len(seen.shared))]
        late = times > np.array(middle)[seen.recording]
    for half in (late, ~late):
        if _second_turn_deg(seen.poses.world_from_body.rotation[half]) < _LEAST_TURN_DEG:
            return float("nan"), float("nan")
        fit, rest = fit_frames(seen.take(half), kinematics=kinematics), seen.take(~half)
        squares.append(fit.rms_mm(rest) ** 2)
        expected.append(_expected(fit, rest, kinematics))
    return float(np.sqrt(np.mean(squares))), float(np.sqrt(np.mean(expected)))


def _expected(fit: FrameFit, rest: Sightings, kinematics: bool) -> float:
    """Mean square in mm^2 that a fit leaves of other poses, by its own covariance.

    What links do to the frames is undone by what they do to the poses, as far as these are alike.
    """
    near = LinearModel.of(fit, rest)
    P, slopes, by_links = fit.covariance, near.slopes[:, :3], 0.0
    free = len(P)
    if not kinematics:
        moved = np.zeros((free, len(fit.links)))  # frames and clocks, by one SD of the links
        moved[:FRAMES] = fit.frames_by_links
        P = P - moved @ moved.T
        left = slopes[:, :, free:] * fit.link_sd - slopes[:, :, :free] @ moved
        by_links = float(np.sum(left**2)) / len(slopes)
    slopes = slopes[:, :, :free]
    frames = np.einsum("nap,pq,naq->n", slopes, P, slopes, optimize=True)
    noise = np.trace(near.covariances[:, :3, :3], axis1=1, axis2=2) * fit.noise
    return float(np.mean(frames + noise)) + by_links


def _second_turn_deg(rotations: Floats) -> float:
    """How far something was turned about its second principal axis."""
    middle = nearest_rotation(rotations.sum(axis=0).T.ravel())
    turns = RigidTransform(middle.T @ rotations, np.zeros(3)).rotvec
    axes = np.linalg.svd(turns - turns.mean(axis=0), full_matrices=False)[2].T
    low, high = np.percentile(turns @ axes, (1, 99), axis=0)
    return float(np.degrees(high - low)[1])


def _not_separable(fit: FrameFit, seen: Sightings, kinematics: bool) -> list[str]:
    """What remains uncertain of the frames, and why, in sentences."""
    said = [] if seen.chain is None else _open(fit, seen)
    if seen.chain is None:
        said.append("how the flange is turned: the robot's kinematics are not known")
    elif not isinstance(seen.chain, ToolPoses) and (still := _still_joints(seen)):
        said.append(
            f"joints {', '.join(still)} stood still: errors of theirs and of the links between are "
            "counted as the base's or the tool's, which hold for this posture of them"
        )
    sd = np.sqrt(np.diag(fit.covariance))
    for block, start in (("world_from_base", 0), ("body_from_flange", 6)):
        place, turn = sd[start : start + 3], sd[start + 3 : start + 6]
        if seen.chain is None and start:
            turn = np.zeros(3)
        if np.linalg.norm(place) < _WEAK_MM and np.linalg.norm(turn) < _WEAK_RAD:
            continue
        known = f"{block} is known to {np.linalg.norm(place):.1f} mm and "
        known += f"{np.degrees(np.linalg.norm(turn)):.2f} deg (SD, 3-D)"
        said.append(f"{known}: {_reason(fit, start, isinstance(seen.chain, ToolPoses))}")
    if kinematics and seen.chain:
        kept = sd[-seen.links :] / fit.link_sd > _NOT_SHOWN
        names = np.array(link_names(seen.chain))[kept]
        if len(names):
            said.append(f"not shown by this motion: {', '.join(names)}")
    return said


def _open(fit: FrameFit, seen: Sightings) -> list[str]:
    """The directions of base and tool that the motion does not determine, one after the other."""
    directions = fit.open_directions(seen)
    if not directions.shape[1]:
        return []
    # Shifts are those combinations of the directions that turn nothing.
    _, sizes, v = np.linalg.svd(directions[[3, 4, 5, 9, 10, 11]])
    sizes = np.append(sizes, np.zeros(len(v) - len(sizes)))
    said = []
    for size, mix in zip(sizes, v, strict=True):
        x = directions @ mix
        a, b, c = _unit(x[3:6] if size > _PURE else x[:3])
        how = "turned together about" if size > _PURE else "together along"
        said.append(f"{how} the axis ({a:.2f}, {b:.2f}, {c:.2f}) of the world")
    sentence = (
        f"not determined by this motion: where base and tool are {' and '.join(said)}; all else "
        "is as stated: turn the tool about another axis"
    )
    return [sentence]


def _unit(axis: Floats) -> Floats:
    """A direction with its largest component positive."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return np.asarray(axis / np.linalg.norm(axis) + 0.0)  # no -0.0


def _still_joints(seen: Sightings) -> list[str]:
    assert seen.chain is not None
    ranges = np.ptp(seen.joints, axis=0)
    limits = [_STILL_MM if joint.prismatic else _STILL_RAD for joint in seen.chain.joints]
    return [str(k + 1) for k in np.flatnonzero(ranges < limits)]


def _reason(fit: FrameFit, start: int, is_tool: bool) -> str:
    """Why six parameters are uncertain: errors of joints, others of the robot, or little motion."""
    rows, what = slice(start, start + 6), "base" if start == 0 else "tool"
    scale = np.diag(fit.covariance)[rows]
    by_joint = (fit.frames_by_links[rows] ** 2 / scale[:, None]).reshape(6, -1, 6).sum(axis=(0, 2))
    if by_joint.sum() >= 3.0 and is_tool:
        causes = "the robot's own errors (links, joints homed wrongly) move"
    elif by_joint.sum() >= 3.0:  # of six: at least half of the variance
        first = np.argsort(-by_joint)[: max(1, int(np.sum(by_joint > by_joint.max() / 3)))]
        causes = f"constant errors of joints {', '.join(str(k + 1) for k in sorted(first))} move"
    elif fit.noise / fit.share > _ROBOTS_OWN:
        causes = "the robot's own errors (slack, cables, joints homed wrongly) move"
    else:
        return "this motion shows no more; turn and move the tool further"
    return (
        f"{causes} the tip as another {what} would, and cannot be separated from it: labels are "
        f"relative to the fitted {what}; else measure it by markers"
    )


_CANDIDATES = 3000
_FARTHER = 0.25  # share of a joint's range by which it may go beyond it
_LEAST_FARTHER_RAD, _LEAST_FARTHER_MM = float(np.deg2rad(15.0)), 20.0
_ROOM = 0.15  # share of the tip's ranges by which it may leave them: the cameras see no farther
_LEAST_ROOM_MM = 50.0
_MOST_TURN_RAD = float(np.deg2rad(20.0))  # beyond the turns seen: the balls must stay in sight


def next_pose(fit: FrameFit, seen: Sightings) -> dict[str, Any] | None:
    """The joints (deg and mm) of the pose that would help most, and by how much; None if unknown.

    Of poses near those that the cameras have seen; the one that makes the product of the variances
    of base and tool smallest, links being as uncertain as they are.
    """
    if seen.chain is None:
        return None
    joints = _candidates(seen)
    if not len(joints):
        return None
    C = posterior_covariance(fit.normal, precision(seen, fit.link_sd))
    near = LinearModel.of(fit, _at(joints, fit, seen))
    H, R = near.slopes, near.covariances * fit.noise
    CH = C @ np.swapaxes(H, 1, 2)
    gains = np.swapaxes(np.linalg.solve(H @ CH + R, np.swapaxes(CH, 1, 2)), 1, 2)
    less = np.einsum("npm,npm->np", gains, CH)[:, :FRAMES]
    before = np.diag(C)[:FRAMES]
    after = np.maximum(before - less, 0.0).reshape(-1, 4, 3).sum(axis=2)
    whole = before.reshape(4, 3).sum(axis=1)
    best = int(np.argmin(np.sum(np.log(after / whole), axis=1)))
    ratio = np.sqrt(after[best] / whole)
    scale = [1.0 if joint.prismatic else float(np.degrees(1.0)) for joint in seen.chain.joints]
    return {
        "joints": np.round(joints[best] * scale, 1),
        "units": ["mm" if joint.prismatic else "deg" for joint in seen.chain.joints],
        "base_sd_ratio": float(min(ratio[:2])),
        "tool_sd_ratio": float(min(ratio[2:])),
    }


def _candidates(seen: Sightings) -> Floats:
    """Joints (k, joints) a little beyond those seen, with the tool about where it was seen."""
    assert seen.chain is not None
    low, high = seen.joints.min(axis=0), seen.joints.max(axis=0)
    slides = np.array([joint.prismatic for joint in seen.chain.joints])
    least = np.where(slides, _LEAST_FARTHER_MM, _LEAST_FARTHER_RAD)
    farther = np.maximum(_FARTHER * (high - low), least)
    rng = np.random.default_rng(0)
    joints = rng.uniform(low - farther, high + farther, (_CANDIDATES, len(low)))
    poses, known = seen.chain.pose(joints), seen.chain.pose(seen.joints)
    near, far = known.translation.min(axis=0), known.translation.max(axis=0)
    room = np.maximum(_ROOM * (far - near), _LEAST_ROOM_MM)
    inside = ((poses.translation > near - room) & (poses.translation < far + room)).all(axis=1)
    middle = nearest_rotation(known.rotation.sum(axis=0).T.ravel())
    turned = _angles(middle, known.rotation).max() + _MOST_TURN_RAD
    return np.asarray(joints[inside & (_angles(middle, poses.rotation) < turned)])


def _angles(middle: Floats, rotations: Floats) -> Floats:
    return np.linalg.norm(RigidTransform(middle.T @ rotations, np.zeros(3)).rotvec, axis=1)


def _at(joints: Floats, fit: FrameFit, seen: Sightings) -> Sightings:
    """Sightings at these joints: where the model puts the body, as sure as the others are."""
    assert seen.chain is not None
    n = len(joints)
    places = seen.chain.pose(joints)
    poses = fit.world_from_base @ places @ fit.body_from_flange.inverse()
    P = np.broadcast_to(np.median(seen.poses.covariances, axis=0), (n, 6, 6))
    return replace(
        seen,
        poses=PoseTable(np.zeros(n), poses, P),
        recording=np.zeros(n, dtype=np.int64),
        reported_mm=places.translation,
        joints=joints,
        rates=np.zeros_like(joints),
    )

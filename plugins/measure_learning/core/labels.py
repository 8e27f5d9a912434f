"""What labels are: in one unit and frame, and the robot's errors, no frame, tool or clock."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from measure.arrays import Floats, rms_length
from measure.errors import EstimatorError
from measure.geometry import RigidTransform, align_points, skew
from measure.host import Dataset
from measure.limits import CLEAR_RATIO
from measure.robots import SerialChain, StateSchema
from measure_learning.core.slips import Misfit, changed
from measure_learning.core.turns import align_turns
from measure_learning.onnx.rotation import turn_errors

_MIN_SPREAD_MM = 1.0  # Spread of the positions below which their unit is not checked
_MIN_SPREAD_SHARE = 1e-4
"""Least spread of the reported positions, as a share of that of the measured ones."""
_MIN_ROWS, _MIN_PLANE_SPREAD_MM = 20, 10.0
"""Fewer positions, or positions nearer to one line, do not determine a frame."""
_MIN_CORRELATION = 0.8
_MIN_APART_DEG = 3.0  # of rotations that may be inverted


def check_units(name: str, measured_mm: Floats, reported_mm: Floats) -> None:
    """Refuse positions (n, 3) of the same instants that are not both in mm (EstimatorError)."""
    spread = np.linalg.norm(measured_mm.std(axis=0))
    expected = np.linalg.norm(reported_mm.std(axis=0))
    if max(spread, expected) < _MIN_SPREAD_MM:
        return
    ratio = spread / max(float(expected), 1e-12)
    for factor, what in ((1e-3, "metres"), (1e-1, "centimetres"), (1e3, "micrometres")):
        if 0.3 < ratio / factor < 3.0:
            raise EstimatorError(
                f"{name}: the measured positions look like {what} (they spread {ratio:.2g} times "
                "as far as the robot's reported ones), or these are not in mm: convert them to mm"
            )
    if expected < _MIN_SPREAD_SHARE * spread:
        raise EstimatorError(
            f"{name}: the robot's log reports a tip that stands still while the measured one moves "
            f"by {spread:.1f} mm: are these the right columns, and is their unit?"
        )
    if (
        np.median(np.linalg.norm(measured_mm, axis=1))
        < 1e-1 * np.median(np.linalg.norm(reported_mm, axis=1))
        and spread < 0.3 * expected
    ):
        raise EstimatorError(
            f"{name}: measured and reported positions are of different size: use mm"
        )


def check_frames(name: str, measured_mm: Floats, reported_mm: Floats) -> None:
    """Refuse (EstimatorError) positions (n, 3) of one time that no rigid motion brings together.

    Compared by the rotation that brings the reported positions nearest to the measured ones (Kabsch
    1976), where the positions spread enough.
    """
    if not determine_frame(reported_mm):
        return
    ours, theirs = (p - p.mean(axis=0) for p in (measured_mm, reported_mm))
    u, values, v = np.linalg.svd(ours.T @ theirs)
    handed = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    size = float(np.sqrt((ours**2).sum() * (theirs**2).sum()))
    turned, mirrored = float(handed @ values) / size, float(values.sum()) / size
    wrong = ""
    if mirrored < _MIN_CORRELATION:
        wrong = (
            f"do not go together (correlation {mirrored:.2f}): is the clock offset right? A tool "
            "far from the body's origin, or another frame, is found by `measure register`."
        )
    elif (
        1 - turned**2 > CLEAR_RATIO * (1 - mirrored**2)
        and _spread(reported_mm)[2] > _MIN_PLANE_SPREAD_MM
    ):
        wrong = "are mirror images of each other: are two axes exchanged, or one reversed?"
    if wrong:
        raise EstimatorError(
            f"{name}: the measured and the reported positions {wrong} Their difference would be "
            "learnt as the robot's error"
        )


def check_turns(name: str, measured: Floats, modelled: Floats, *, most_deg: float = np.inf) -> None:
    """Refuse (EstimatorError) rotations (n, 3, 3) of a body that are not those of the flange.

    They are farther apart than `most_deg` (RMS), or go together once the measured are inverted.
    """
    apart, inverted = (
        np.degrees(align_turns(modelled, turns)[2])
        for turns in (measured, np.swapaxes(measured, 1, 2))
    )
    said = f"{name}: the measured rotations are {apart:.1f} deg (RMS) from those of the joints"
    if apart > max(_MIN_APART_DEG, CLEAR_RATIO * inverted):
        raise EstimatorError(
            f"{said}, and inverted {inverted:.1f}: qw, qx, qy, qz must stand in this order and "
            "turn the body's axes into the world's"
        )
    if apart > most_deg:
        raise EstimatorError(
            f"{said}, whatever base and tool: is --robot the right one, are its joints in their "
            "order, and is this the log of this recording?"
        )


def determine_frame(positions_mm: Floats) -> bool:
    """Whether positions (n, 3) are enough, and far enough from one line, to determine a frame."""
    if len(positions_mm) < _MIN_ROWS:
        return False
    return bool(_spread(positions_mm)[1] >= _MIN_PLANE_SPREAD_MM)


def _spread(positions_mm: Floats) -> Floats:
    """Standard deviations (3,) along the principal axes, the largest first."""
    centred = positions_mm - positions_mm.mean(axis=0)
    return np.asarray(np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred)))


_log = logging.getLogger(__name__)

_LEAST_RMS_MM = 3.0  # Of labels, from which they are called something else than errors
_LEAST_CHANGED, _LEAST_CHANGED_MM = 60, 0.3
"""Labels, and their RMS, from which a scale or a jump is looked for in them."""
FAR_MM = 100.0  # RMS of labels by which no robot errs
_MOST = 0.5  # Share of their RMS that may be left where most of them is explained
_OWN_TURN_RAD, _OWN_SLIDE_MM, _OWN_SHIFT_MM = np.deg2rad(5.0), 10.0, 20.0
"""Joints homed wrongly by so much are a robot's own error, and so is what they do to its frame."""
_OWN_GAIN = 0.35  # So much less than its motors a joint of a cable-driven wrist turns, at most
_OWN_RATIO = 1.5  # Of what these leave to what a frame leaves, up to which they explain as much
_CHAIN_MM = 5.0  # RMS by which a calibrated controller differs from published kinematics, at most
_STEPS = 8
_CURE = (
    "find it with `measure register RUN --robot-log LOG --robot SCHEMA -o frame.toml`, and give "
    "--frame frame.toml"
)


@dataclass(frozen=True, eq=False)
class LabelFacts:
    """Labels (usable ones) in mm, per axis where there are three."""

    rms_mm: float  # 3-D
    mean_mm: Floats  # (3,)
    sd_mm: Floats  # (3,)
    largest_mm: Floats  # (3,) absolute values
    turns: int  # how many of them hold the tip's rotation
    turn_deg: float | None  # RMS of these

    @classmethod
    def of(cls, data: Dataset) -> LabelFacts | None:
        """None if there is no usable label."""
        e = data.errors_mm[data.usable]
        if not len(e):
            return None
        turns = np.empty((0, 3))
        if data.turns is not None:
            turns = data.turns.vectors_rad[data.usable & data.turns.known]
        turn_deg = float(np.degrees(rms_length(turns))) if len(turns) else None
        largest = np.abs(e).max(axis=0)
        return cls(rms_length(e), e.mean(axis=0), e.std(axis=0), largest, len(turns), turn_deg)


@dataclass(frozen=True, eq=False)
class Paired:
    """Measured and reported positions of the same n instants, in mm."""

    measured_mm: Floats  # (n, 3)
    reported_mm: Floats  # (n, 3)
    velocity_mm_s: Floats | None  # (n, 3) as reported; None if the clock is not in question
    joints: Floats  # (n, joints), of the chain
    chain: SerialChain | None
    coupled: tuple[int, ...] = ()  # joints of a cable-driven wrist


@dataclass(frozen=True, eq=False)
class _Doubt:
    """What labels may be instead of errors: measured = frame(reported + R tool + v delay)."""

    frame: RigidTransform
    tool_mm: Floats
    delay_s: float
    left_mm: float


def not_the_robot(pairs: Paired) -> str | None:
    """What explains most of the labels and is no error of the robot, with the figure; or None."""
    errors = pairs.measured_mm - pairs.reported_mm
    size = rms_length(errors)
    said = f"labels of {size:.1f} mm RMS are no errors of the robot"
    unexplained = f"{said}: none errs by so much" if size > FAR_MM else None
    if size < _LEAST_RMS_MM or not determine_frame(pairs.reported_mm):
        return unexplained
    groups = {"frame": range(6)}
    if pairs.chain is not None:
        groups["tool"] = range(6, 9)
    if pairs.velocity_mm_s is not None:
        groups["clock"] = range(9, 10)
    every = _explain(pairs, [c for columns in groups.values() for c in columns])
    if every.left_mm > _MOST * size or _own(pairs, every):
        return unexplained
    single = {name: _explain(pairs, list(columns)) for name, columns in groups.items()}
    name, best = min(single.items(), key=lambda item: item[1].left_mm)
    if best.left_mm > max(_MOST * size, 2 * every.left_mm):
        name, best = "all", every
    return f"{said}: {_words(name, best)}"


def check_labels(name: str, doubts: Sequence[str], *, as_it_is: bool) -> None:
    """Refuse labels in doubt (EstimatorError), or warn if they are to be kept as they are."""
    for doubt in doubts:
        if not as_it_is:
            raise EstimatorError(f"{name}: {doubt}; or keep them with --as-it-is")
        _log.warning("%s: %s", name, doubt)


def label_doubts(
    schema: StateSchema,
    states: Floats,
    errors_mm: Floats,
    velocity_mm_s: Floats | None = None,
    times_s: Floats | None = None,
) -> tuple[str, ...]:
    """Why labels (n, 3) of states (n, features) may be no errors of the robot, and what to do.

    With the reported velocity (n, 3) if the clock is in question, and with the cameras' times (n,)
    of one recording in which something may have moved.
    """
    joints, reported = schema.joint_positions(states), schema.position_mm(states)
    measured, chain = reported + errors_mm, schema.chain
    pairs = Paired(measured, reported, velocity_mm_s, joints, chain, schema.coupled)
    causes = (
        (chain_doubt(chain, joints, reported), "describe the robot as it is"),
        (not_the_robot(pairs), _CURE),
    )
    doubts = [f"{doubt}: {cure}" for doubt, cure in causes if doubt is not None]
    if not doubts and (cause := _changed(pairs, times_s)) is not None:
        doubts.append(cause)
    return tuple(doubts)


def _changed(pairs: Paired, times_s: Floats | None) -> str | None:
    """A scale of the cameras, or a jump, that explains most of what no frame does; or None."""
    errors, places, n = pairs.measured_mm - pairs.reported_mm, pairs.reported_mm, len(pairs.joints)
    size = rms_length(errors)
    if n < _LEAST_CHANGED or size < _LEAST_CHANGED_MM or not determine_frame(places):
        return None
    slopes = np.zeros((n, 3, 6))
    slopes[:, :, :3] = np.eye(3)
    slopes[:, :, 3:] = -skew(places - places.mean(axis=0))
    turns = None if pairs.chain is None else pairs.chain.pose(pairs.joints).rotation
    recording = np.zeros(n, dtype=np.int64)
    misfit = Misfit(
        errors, slopes, np.zeros(6), np.zeros((n, 3, 3)), places, recording, times_s, turns
    )
    own = np.inf if pairs.chain is None else _own_left_mm(pairs, pairs.chain)
    if (cause := changed(misfit, own)) is None:
        return None
    return f"labels of {size:.2f} mm RMS are not all the robot's errors: {cause}"


def _words(name: str, cause: _Doubt) -> str:
    turn = np.degrees(np.linalg.norm(cause.frame.rotvec))
    shift = np.linalg.norm(cause.frame.translation)
    tool = ", ".join(f"{value:.1f}" for value in cause.tool_mm)
    parts = []
    if name in ("frame", "all"):
        parts.append(f"a world turned by {turn:.1f} deg and shifted by {shift:.1f} mm")
    if name in ("tool", "all"):
        parts.append(f"a tool offset of ({tool}) mm")
    if name == "clock" or (name == "all" and abs(cause.delay_s) > 1e-3):
        parts.append(f"a clock that is {1e3 * cause.delay_s:+.1f} ms off")
    verb = "explain" if len(parts) > 1 else "explains"
    return f"{' and '.join(parts)} {verb} them but for {cause.left_mm:.2f} mm"


def _explain(pairs: Paired, columns: list[int]) -> _Doubt:
    """Least squares over a frame (0 to 5), a tool (6 to 8) and a delay (9), as far as asked for."""
    n = len(pairs.reported_mm)
    turn = np.broadcast_to(np.eye(3), (n, 3, 3))
    if pairs.chain is not None:
        turn = pairs.chain.pose(pairs.joints).rotation
    velocity = np.zeros((n, 3)) if pairs.velocity_mm_s is None else pairs.velocity_mm_s
    frame, rest = RigidTransform.identity(), np.zeros(4)
    if 0 in columns:
        frame = align_points(pairs.measured_mm, pairs.reported_mm)
    for _ in range(_STEPS):
        place = pairs.reported_mm + turn @ rest[:3] + velocity * rest[3]
        left = pairs.measured_mm - frame.apply(place)
        slopes = np.zeros((n, 3, 10))
        slopes[:, :, :3] = np.eye(3)
        slopes[:, :, 3:6] = -skew(place @ frame.rotation.T)
        slopes[:, :, 6:9] = frame.rotation @ turn
        slopes[:, :, 9] = velocity @ frame.rotation.T
        chosen = slopes[:, :, columns].reshape(3 * n, -1)
        x = np.zeros(10)
        x[columns] = np.linalg.lstsq(chosen, left.ravel())[0]
        frame, rest = frame.perturb(x[:6]), rest + x[6:]
    place = pairs.reported_mm + turn @ rest[:3] + velocity * rest[3]
    return _Doubt(
        frame, rest[:3], float(rest[3]), rms_length(pairs.measured_mm - frame.apply(place))
    )


def _own(pairs: Paired, cause: _Doubt) -> bool:
    """Whether joints homed wrongly, and a wrist's gains, explain as much: a robot's own errors."""
    if (chain := pairs.chain) is None:
        middle = pairs.reported_mm.mean(axis=0)
        shift = np.linalg.norm(cause.frame.apply(middle) - middle)
        turned = np.linalg.norm(cause.frame.rotvec) > _OWN_TURN_RAD
        return not (turned or shift > _OWN_SHIFT_MM)
    return _own_left_mm(pairs, chain) < max(_OWN_RATIO * cause.left_mm, _LEAST_RMS_MM)


def not_the_tip(schema: StateSchema, states: Floats, measured: Floats) -> str | None:
    """Why rotations (n, 3, 3) of a body are not those of the tip but for its errors; or None."""
    assert schema.chain is not None
    joints = schema.joint_positions(states)
    modelled = schema.chain.pose(joints).rotation
    errors = turn_errors(measured, modelled)
    base, flange, left = align_turns(modelled, measured)
    slopes = schema.chain.jacobian(joints)[:, 3:]
    own = _own_left(errors, slopes, joints, schema.chain, schema.coupled)
    size, left, own = np.degrees([rms_length(errors), left, own])
    if left > _MOST * size or own < max(_OWN_RATIO * left, _MIN_APART_DEG):
        return None
    world, body = (np.degrees(np.linalg.norm(turn_errors(r, np.eye(3)))) for r in (base, flange))
    return (
        f"the tip's rotation is not among the labels: {size:.1f} deg (RMS) from the joints', "
        f"including a world turned by {world:.1f} deg and a body turned by {body:.1f} deg against "
        f"the tip leave {left:.1f}: find both with `measure register`, and give --frame frame.toml"
    )


def _own_left_mm(pairs: Paired, chain: SerialChain) -> float:
    """RMS of what joints homed wrongly, and a wrist's gains, leave of the labels."""
    errors, slopes = pairs.measured_mm - pairs.reported_mm, chain.jacobian(pairs.joints)[:, :3]
    return _own_left(errors, slopes, pairs.joints, chain, pairs.coupled)


def _own_left(
    errors: Floats, slopes: Floats, joints: Floats, chain: SerialChain, coupled: Sequence[int]
) -> float:
    """The same of errors (n, 3) whose slopes by the joints are (n, 3, joints)."""
    from scipy.optimize import lsq_linear  # slow to load

    wrist = list(coupled)
    most = np.array([_OWN_SLIDE_MM if j.prismatic else _OWN_TURN_RAD for j in chain.joints])
    gains = slopes[:, :, wrist] * (_OWN_GAIN * joints[:, None, wrist])
    slopes = np.concatenate([slopes * most, gains], axis=2)
    found = lsq_linear(slopes.reshape(errors.size, -1), errors.ravel(), (-1, 1))
    return float(np.sqrt(2 * found.cost / len(errors)))


def chain_doubt(chain: SerialChain | None, joints: Floats, reported_mm: Floats) -> str | None:
    """How far the chain is from what the robot reports, and what would mend it; None if it fits."""
    if chain is None or len(joints) < _MIN_ROWS:
        return None
    tip = chain.tip_mm(joints)
    size = rms_length(reported_mm - tip)
    if size < _CHAIN_MM:
        return None
    other = Paired(reported_mm, tip, None, joints, chain)
    tool, frame = _explain(other, [6, 7, 8]), _explain(other, list(range(6)))
    said = f"the kinematics put the tip {size:.1f} mm (RMS) from where the log reports it: "
    longer = rms_length(reported_mm) / rms_length(tip)
    if not 0.2 < longer < 5.0:
        return f"{said}{longer:.3g} times as far from the base: is that in mm?"
    if tool.left_mm < 0.1 * size:
        add = (chain.tool[:3, 3] + chain.tool[:3, :3] @ tool.tool_mm).round(2) + 0.0  # no -0.0
        return f"{said}with tool_mm = {add.tolist()} in robot.toml they fit"
    if frame.left_mm < 0.1 * size:
        turn = np.degrees(np.linalg.norm(frame.frame.rotvec))
        shift = np.linalg.norm(frame.frame.translation)
        return (
            f"{said}the log's base is turned by {turn:.1f} deg and shifted by {shift:.1f} mm "
            "against that of the kinematics"
        )
    return f"{said}is --robot the right one, and are alpha_deg, a_mm, offset_deg and d_mm right?"

"""Causes of what a model leaves: the block of it, or the slip, without which all fits.

What is wrong altogether (axes of a left hand, joints in another order) is undone in turn and judged
by the closed form, which needs no start. What is wrong by a little (a frame, a tool, a clock, the
scale of the cameras, a camera that was pushed) is one more block of the linear model.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Bools, Floats, rms_length
from measure.errors import DegenerateGeometryError, EstimatorError
from measure.estimation.blocks import BlockFit, fit_blocks
from measure.geometry import RigidTransform, align_points
from measure.geometry.covariance import inverted
from measure.host import Dataset
from measure.limits import CLEAR_RATIO, LEVER_MM
from measure.robots import SerialChain, StateSchema
from measure_learning.core.frame_fit import align_turns, fit_frames, priors, quick_miss, turns_agree
from measure_learning.core.robot_model import LinearModel, RobotState, Sightings
from measure_learning.onnx.rotation import turn_errors
from measure_learning.robots.links import usual_sd

_COMPARED, _FITTED = 60, 120  # poses by which slips are ranked, and the best of them fitted
_FINALISTS = 4  # slips ranked by all, after the rotations alone; and those fitted
_MOST_LEFT = 0.1  # share of the motion that may be left then
_MOST_JOINTS = 7  # whose orders are all tried: 5040
EXPLAINED = 0.6
"""Share of the RMS that each block must leave at most, to be a cause. A robot's own errors (slack,
links) are no noise, so that BIC, though it counts independent poses alone, blames half of six arms
whose links are off by 0.3 mm and 0.03 deg for the cameras' scale; of their RMS it leaves 0.91."""
_LEAST_SCALE, _MOST_SCALE = 2e-3, 0.2
"""Errors of the cameras' scale: those of long links look like smaller ones; by more nothing fits.
"""
_SCALE_ROUNDS = 3  # of weighing by what is left: at first the scale is in it
_LEAST_JUMP_MM, _LEAST_JUMP_RAD = 0.5, 0.002
_WEIGHED = 600  # poses by which blocks are compared
_STEPS = 8  # of Gauss and Newton, to the values of the blocks
_CUTS = 40  # places in time where a jump is looked for
_EDGE = 0.08  # share of the poses that must be on either side


@dataclass(frozen=True, eq=False)
class _KnownSlip:
    """What may be wrong, and the sightings with it undone."""

    said: str
    cure: str
    undone: Sightings


def explain(seen: Sightings, joint_names: Sequence[str], eye_in_hand: bool = False) -> str | None:
    """The slip without which base and tool explain poses that they do not explain now; or None."""
    if seen.chain is None:
        return None
    few = seen.take(_some(len(seen.poses), _COMPARED))
    every = _slips(few, joint_names, eye_in_hand)
    likely = heapq.nlargest(_COMPARED, every, key=lambda slip: turns_agree(slip.undone))
    ranked = sorted(likely, key=lambda slip: quick_miss(slip.undone))
    wanted = {slip.said for slip in ranked[:_FINALISTS]}
    more = seen.take(_some(len(seen.poses), _FITTED))
    slips = [slip for slip in _slips(more, joint_names, eye_in_hand) if slip.said in wanted]
    before = _left_mm(more)
    left, best = min(((_left_mm(slip.undone), slip) for slip in slips), key=lambda pair: pair[0])
    places = best.undone.poses.world_from_body.translation
    spread = float(np.linalg.norm(places.std(axis=0)))
    if left > before / CLEAR_RATIO or left > max(_MOST_LEFT * spread, 1.0):
        return None
    return (
        f"{best.said}: {left:.2f} mm are left once that is undone, {before:.0f} mm as it is: "
        f"{best.cure}"
    )


def _size_mm(residuals: Floats) -> float:
    """RMS of residuals (n, 3 or 6) in mm, turns at a lever."""
    levers = np.repeat([1.0, LEVER_MM], 3)[: residuals.shape[1]]
    return float(rms_length(residuals * levers))


def _some(count: int, most: int) -> slice:
    return slice(None, None, -(-count // most))


def _left_mm(seen: Sightings) -> float:
    """RMS that a fit of base, tool and clock leaves, turns at a lever; more for poses left out."""
    try:
        fit = fit_frames(seen, kinematics=False)
    except (np.linalg.LinAlgError, DegenerateGeometryError):
        return float("inf")
    return _size_mm(fit.residuals(seen.take(fit.kept))) / max(float(fit.kept.mean()) ** 3, 1e-3)


def _slips(seen: Sightings, names: Sequence[str], eye_in_hand: bool) -> Iterator[_KnownSlip]:
    assert seen.chain is not None
    poses = seen.poses
    back, P = inverted(poses.world_from_body, poses.covariances)
    if eye_in_hand:
        said = "the cameras stand in the world and the body is on the tool"
        cure = "leave out --eye-in-hand"
    else:
        said = "the poses fit when they are inverted"
        cure = (
            "if the cameras are on the flange and the body stands in the world, give --eye-in-hand;"
            " else the table holds body_from_world: invert it"
        )
    undone = replace(poses, world_from_body=back, covariances=P)
    yield _KnownSlip(said, cure, replace(seen, poses=undone))
    place = poses.world_from_body
    for mirror, how in _MIRRORS:
        both = RigidTransform(mirror @ place.rotation @ mirror, place.translation @ mirror)
        said = "the poses are of a left hand's axes (one is mirrored, or two are exchanged)"
        others = [(f"{how} in the poses' positions", replace(both, rotation=place.rotation))]
        if mirror is _MIRRORS[0][0]:
            others.append((said, both))
        for said, other in others:
            cure = "write positions and rotations in the same axes, of a right hand"
            yield _KnownSlip(said, cure, replace(seen, poses=replace(poses, world_from_body=other)))
    yield from _joint_slips(seen, seen.chain, names)
    if seen.apart:
        yield from _row_slips(seen)


_MIRRORS = (
    (np.diag([-1.0, 1, 1]), "x is mirrored"),
    (np.diag([1.0, -1, 1]), "y is mirrored"),
    (np.diag([1.0, 1, -1]), "z is mirrored"),
    (np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]), "x and y are exchanged"),
    (np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]]), "x and z are exchanged"),
    (np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]), "y and z are exchanged"),
)


def _joint_slips(seen: Sightings, chain: SerialChain, names: Sequence[str]) -> Iterator[_KnownSlip]:
    n = chain.size
    orders = itertools.permutations(range(n)) if n <= _MOST_JOINTS else _exchanges(n)
    for order in itertools.islice(orders, 1, None):
        held = ", ".join(names[k] for k in order)
        said = f"the joints are in another order ({held} are the robot's 1 to {n})"
        cure = "name the columns in the robot's order (robot.toml, [log] joints)"
        yield _KnownSlip(said, cure, _with_joints(seen, chain, list(order), np.ones(n)))
    for count in (1, 2, 3):
        for some in itertools.combinations(range(n), count):
            signs = np.ones(n)
            signs[list(some)] = -1.0
            which = " and ".join(names[k] for k in some)
            turn = "turns" if count == 1 else "turn"
            said, cure = f"{which} {turn} the other way", "reverse that in the log"
            yield _KnownSlip(said, cure, _with_joints(seen, chain, list(range(n)), signs))


def _row_slips(seen: Sightings) -> Iterator[_KnownSlip]:
    """Stops whose poses and joints are out of step by a row, all or from one of them on."""
    n = len(seen.poses)
    for first, (early, where) in itertools.product(range(n - 1), ((0, "below"), (1, "above"))):
        poses = np.delete(np.arange(n), -1 if early else first)
        states = np.delete(np.arange(n), first if early else -1)
        since = f"from stop {first + 1} on " if first else ""
        said = f"{since}each pose is one row {where} its joints"
        cure = "pair them again: is a row missing, or there twice?"
        undone = replace(seen.take(states), poses=seen.poses.take(poses))
        yield _KnownSlip(said, cure, undone)


def _exchanges(n: int) -> Iterator[tuple[int, ...]]:
    yield tuple(range(n))
    for a, b in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[a], order[b] = b, a
        yield tuple(order)


def _with_joints(seen: Sightings, chain: SerialChain, order: list[int], signs: Floats) -> Sightings:
    joints = seen.joints[:, order] * signs
    return replace(
        seen, joints=joints, rates=seen.rates[:, order] * signs, reported_mm=chain.tip_mm(joints)
    )


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the rest is with some of the blocks free."""

    blocks: tuple[str, ...]
    left_mm: float  # RMS, turns at a lever
    state: RobotState
    values: Floats  # of the last block
    at_s: float = 0.0  # since when, if it began midway


def likeliest(
    causes: Iterable[Explanation], without_mm: float, least_mm: float = 0.0
) -> Explanation | None:
    """The explanation that leaves least, as it counts beside one with fewer blocks.

    None if no more is left without any. What is left below `least_mm` is a robot's own.
    """

    def cost_mm(cause: Explanation) -> float:
        return max(cause.left_mm / EXPLAINED, least_mm) / EXPLAINED ** (len(cause.blocks) - 1)

    best = min(causes, key=cost_mm)
    return best if cost_mm(best) < without_mm else None


def explain_by(seen: Sightings, blocks: tuple[str, ...]) -> Explanation:
    """Frames and clocks that are as reported, but for blocks of the model that are free."""
    state = RobotState.nominal(seen)
    if "frame" in blocks:
        state = RobotState.nominal(seen, align_points(seen.places_mm, seen.reported_mm))
    for _ in range(_STEPS):
        near = LinearModel.of(state, seen)
        free = {name: near.blocks[name] for name in blocks}
        fit = fit_blocks(near.residuals, free, np.eye(near.residuals.shape[1]))
        state = state.moved(fit.values)
    left = _size_mm(LinearModel.of(state, seen).residuals)
    return Explanation(blocks, left, state, fit.values[blocks[-1]])


def fewer(seen: Sightings) -> Sightings:
    """As many sightings, evenly spread, as tell which block explains what is left."""
    return seen.take(_some(len(seen.poses), _WEIGHED))


def changed(
    state: RobotState, seen: Sightings, own_mm: float = np.inf, *, frame_alone: bool = False
) -> str | None:
    """A scale of the cameras, or a jump of world or body, that explains what is left; or None.

    It must explain clearly more than the robot's own errors, where these leave `own_mm`, and more
    than frames and clocks that are free (`frame_alone`: the frame).
    """
    seen = fewer(seen)
    near, known = LinearModel.of(state, seen), priors(seen, usual_sd(seen.links))
    free = {name: near.blocks[name] for name in ("frame", "tool", "delay")}
    if frame_alone:
        free, known = {"frame": free["frame"]}, {"links": known["links"]}
    places, size = seen.places_mm, near.residuals.shape[1]
    middle = places.mean(axis=0)
    by_scale = np.zeros((len(places), size, 1))
    by_scale[:, :3, 0] = places - middle

    def left(residuals: Floats, **more: Floats) -> BlockFit:
        # Poses that state no covariance and differ by a constant leave it singular.
        spread = near.covariances.mean(axis=0) + residuals.T @ residuals / len(residuals)
        return fit_blocks(near.residuals, free | more, np.linalg.pinv(spread), known)

    def explained(name: str, slopes: Floats, at_s: float = 0.0) -> Explanation:
        fit = left(near.residuals, cause=slopes)
        return Explanation((name,), _size_mm(fit.residuals), state, fit.values["cause"], at_s)

    causes = [explained("scale", by_scale)]
    jumping = {"frame": "the cameras' world, or the robot's base,"}
    if seen.chain is not None:
        jumping["tool"] = "the body on the tool"
    for rows, cut in _cuts(seen):
        causes += [
            explained(name, near.blocks[name] * rows[:, None, None], cut) for name in jumping
        ]
    before = _size_mm(left(near.residuals).residuals)
    if (cause := likeliest(causes, min(before, own_mm))) is None:
        return None
    turns = f" (turns at {LEVER_MM:g} mm)" if size > 3 else ""
    words = f"{cause.left_mm:.2f} mm are left then, {before:.2f} mm as it is{turns}"
    x = cause.values
    if cause.blocks == ("scale",):
        if not _LEAST_SCALE < abs(x[0]) < _MOST_SCALE:
            return None
        # Links that are all too long look the same; without them base and tool take a third of it.
        known["scale"] = np.array([_MOST_SCALE**-2.0])
        rest = near.residuals
        for _ in range(_SCALE_ROUNDS):
            fit = left(rest, links=near.blocks["links"], scale=by_scale)
            rest = fit.residuals
        scale, sd = fit.values["scale"][0], np.sqrt(fit.covariances["scale"][0, 0])
        return (
            f"the cameras' world is {1 + scale:.4f} times as large as the robot's, SD {sd:.4f}: "
            f"{words}: was the "
            "board's square size that of the print, and the body file that of the body? Calibrate "
            "again (or the robot's links are all too long by that)"
        )
    (name,) = cause.blocks
    shift, rad = x[:3], float(np.linalg.norm(x[3:]))
    if name == "frame":  # of the middle of all places
        shift = shift + np.cross(x[3:], middle - state.world_from_base.translation)
    mm = float(np.linalg.norm(shift))
    if mm < _LEAST_JUMP_MM and rad < _LEAST_JUMP_RAD:
        return None
    return (
        f"{jumping[name]} moved by {mm:.1f} mm and {np.degrees(rad):.2f} deg at {cause.at_s:.1f} s "
        f"of the cameras' time: {words}: register what comes before and after apart"
    )


def _cuts(seen: Sightings) -> Iterator[tuple[Bools, float]]:
    """Instants at which something may have jumped, and the sightings (n,) since then."""
    if seen.apart:
        return
    times, places = seen.poses.times_s, seen.reported_mm  # in which nothing jumps
    for recording in np.unique(seen.recording):
        rows = seen.recording == recording
        for cut in np.quantile(times[rows], np.linspace(_EDGE, 1 - _EDGE, _CUTS)).tolist():
            late = rows & (times >= cut)
            if _overlap(places[rows & ~late], places[late]):
                yield late, cut


def _overlap(one: Floats, other: Floats) -> bool:
    """Whether places (n, 3) are among others (m, 3): else errors of the place look like a jump."""
    apart = float(np.linalg.norm(one.mean(axis=0) - other.mean(axis=0)))
    return apart < float(np.linalg.norm(one.std(axis=0)) + np.linalg.norm(other.std(axis=0))) / 2


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
_OWN_TURN_RAD, _OWN_SLIDE_MM, _OWN_SHIFT_MM = np.deg2rad(5.0), 10.0, 20.0
"""Joints homed wrongly by so much are a robot's own error, and so is what they do to its frame."""
_OWN_GAIN = 0.35  # So much less than its motors a joint of a cable-driven wrist turns, at most
_CHAIN_MM = 5.0  # RMS by which a calibrated controller differs from published kinematics, at most
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


def not_the_robot(seen: Sightings, coupled: tuple[int, ...] = ()) -> str | None:
    """What explains most of the labels and is no error of the robot, with the figure; or None.

    Args:
        seen: measured and reported positions.
        coupled: joints of a cable-driven wrist.
    """
    size = rms_length(seen.places_mm - seen.reported_mm)
    said = f"labels of {size:.1f} mm RMS are no errors of the robot"
    unexplained = f"{said}: none errs by so much" if size > FAR_MM else None
    if size < _LEAST_RMS_MM or not determine_frame(seen.reported_mm):
        return unexplained
    seen = fewer(seen)
    free = ["frame"]
    if seen.chain is not None:
        free.append("tool")
    if not seen.clocks_known:
        free.append("delay")
    combined = (itertools.combinations(free, k) for k in range(1, len(free) + 1))
    causes = [explain_by(seen, blocks) for blocks in itertools.chain(*combined)]
    own_mm = _own_left_mm(seen, coupled)
    cause = likeliest(causes, min(size, own_mm), _LEAST_RMS_MM)
    if cause is None and "delay" in free:
        cause = _late(seen, coupled, own_mm)
    if cause is None or (seen.chain is None and _as_homed(cause, seen)):
        return unexplained
    return f"{said}: {_words(cause)}"


def _late(seen: Sightings, coupled: tuple[int, ...], own_mm: float) -> Explanation | None:
    """A clock that is off, if it explains what joints that are homed wrongly leave, `own_mm`."""
    both = explain_by(seen, ("frame", "delay"))  # the frame takes what homing does
    left_mm = _own_left_mm(seen, coupled, LinearModel.of(both.state, seen).residuals)
    late = replace(both, blocks=("delay",), left_mm=left_mm)
    return likeliest([late], own_mm, _LEAST_RMS_MM * EXPLAINED)


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
    rates: Floats | None = None,
    times_s: Floats | None = None,
) -> tuple[str, ...]:
    """Why labels (n, 3) of states (n, features) may be no errors of the robot, and what to do.

    With the joints' rates (or the reported velocity, see `Sightings`) if the clock is in question,
    and with the cameras' times (n,) of one recording in which something may have moved.
    """
    joints, reported = schema.joint_positions(states), schema.position_mm(states)
    seen = Sightings.of_points(
        reported + errors_mm, reported, joints, schema.chain, rates=rates, times_s=times_s
    )
    causes = (
        (chain_doubt(schema.chain, joints, reported), "describe the robot as it is"),
        (not_the_robot(seen, schema.coupled), _CURE),
    )
    doubts = [f"{doubt}: {cure}" for doubt, cure in causes if doubt is not None]
    if not doubts and (cause := _changed(seen, schema.coupled)) is not None:
        doubts.append(cause)
    return tuple(doubts)


def _changed(seen: Sightings, coupled: tuple[int, ...]) -> str | None:
    """A scale of the cameras, or a jump, that explains most of what no frame does; or None."""
    size = rms_length(seen.places_mm - seen.reported_mm)
    small = len(seen.poses) < _LEAST_CHANGED or size < _LEAST_CHANGED_MM
    if small or not determine_frame(seen.reported_mm):
        return None
    own_mm = _own_left_mm(seen, coupled)
    if (cause := changed(RobotState.nominal(seen), seen, own_mm, frame_alone=True)) is None:
        return None
    return f"labels of {size:.2f} mm RMS are not all the robot's errors: {cause}"


def _words(cause: Explanation) -> str:
    frame, tool = cause.state.world_from_base, -cause.state.body_from_flange.translation
    parts = []
    if "frame" in cause.blocks:
        turn, shift = np.degrees(np.linalg.norm(frame.rotvec)), np.linalg.norm(frame.translation)
        parts.append(f"a world turned by {turn:.1f} deg and shifted by {shift:.1f} mm")
    if "tool" in cause.blocks:
        parts.append(f"a tool offset of ({', '.join(f'{value:.1f}' for value in tool)}) mm")
    if "delay" in cause.blocks:
        parts.append(f"a clock that is {1e3 * cause.state.clocks_s[0]:+.1f} ms off")
    verb = "explain" if len(parts) > 1 else "explains"
    return f"{' and '.join(parts)} {verb} them but for {cause.left_mm:.2f} mm"


def _as_homed(cause: Explanation, seen: Sightings) -> bool:
    """Whether a frame is as near as joints homed wrongly may make it, of an unknown robot."""
    frame, middle = cause.state.world_from_base, seen.reported_mm.mean(axis=0)
    shift = np.linalg.norm(frame.apply(middle) - middle)
    return bool(np.linalg.norm(frame.rotvec) < _OWN_TURN_RAD and shift < _OWN_SHIFT_MM)


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
    if own < _MIN_APART_DEG or left > EXPLAINED * min(size, own):
        return None
    world, body = (np.degrees(np.linalg.norm(turn_errors(r, np.eye(3)))) for r in (base, flange))
    return (
        f"the tip's rotation is not among the labels: {size:.1f} deg (RMS) from the joints', "
        f"including a world turned by {world:.1f} deg and a body turned by {body:.1f} deg against "
        f"the tip leave {left:.1f}: find both with `measure register`, and give --frame frame.toml"
    )


def _own_left_mm(seen: Sightings, coupled: Sequence[int], errors: Floats | None = None) -> float:
    """RMS of what joints homed wrongly, and a wrist's gains, leave of errors (n, 3) in mm.

    Those are the labels if omitted. It is infinite if the chain is not known.
    """
    if (chain := seen.chain) is None:
        return np.inf
    slopes = chain.jacobian(seen.joints)[:, :3]
    errors = seen.places_mm - seen.reported_mm if errors is None else errors
    return _own_left(errors, slopes, seen.joints, chain, coupled)


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
    other = fewer(Sightings.of_points(reported_mm, tip, joints, chain))
    tool, frame = explain_by(other, ("tool",)), explain_by(other, ("frame",))
    said = f"the kinematics put the tip {size:.1f} mm (RMS) from where the log reports it: "
    longer = rms_length(reported_mm) / rms_length(tip)
    if not 0.2 < longer < 5.0:
        return f"{said}{longer:.3g} times as far from the base: is that in mm?"
    if tool.left_mm < 0.1 * size:
        add = (
            chain.tool[:3, 3] + chain.tool[:3, :3] @ -tool.state.body_from_flange.translation
        ).round(2) + 0.0  # no -0.0
        return f"{said}with tool_mm = {add.tolist()} in robot.toml they fit"
    if frame.left_mm < 0.1 * size:
        base = frame.state.world_from_base
        turn, shift = np.degrees(np.linalg.norm(base.rotvec)), np.linalg.norm(base.translation)
        return (
            f"{said}the log's base is turned by {turn:.1f} deg and shifted by {shift:.1f} mm "
            "against that of the kinematics"
        )
    return f"{said}is --robot the right one, and are alpha_deg, a_mm, offset_deg and d_mm right?"

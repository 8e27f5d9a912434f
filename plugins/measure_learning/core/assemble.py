"""From measured poses and a robot's log to a data set: one clock, labels, and their quality."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from measure.arrays import Bools, Floats, Ints, rms_length
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.geometry.covariance import MAD_TO_SD, inverted
from measure.host import Dataset, Turns
from measure.metrology.poses import PoseTable
from measure.robots import SerialChain, StateSchema
from measure_learning.core.causes import (
    check_frames,
    check_labels,
    check_turns,
    check_units,
    label_doubts,
    not_the_tip,
)
from measure_learning.core.clock import ClockOffset, estimate_offset
from measure_learning.core.scores import join
from measure_learning.onnx.rotation import LEVER_MM, turn_errors
from measure_learning.robots import StateLog

_log = logging.getLogger(__name__)

_LARGEST_OFFSET_S = 3600.0
_LARGEST_RATE_HZ = 10_000.0
_LEAST_JUMP_MM = 25.0  # of a rotation, at the lever: slack wrists jump by several degrees
LONGEST_GAP_S = 0.05  # Labels farther than this from the robot's states are unusable
_MOST_BETWEEN_MM = 1.0
"""RMS by which the tip between two states of a log may be off: several times what cheap cameras err
by. A state that is left out is missed by a cubic over twice the steps by sixteen times as much."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Measured tip positions of one recording, on the cameras' clock."""

    name: str  # of the recording; it becomes the trajectory's id
    times_s: Floats  # (n,) increasing
    positions_mm: Floats  # (n, 3), in the robot's base frame; NaN where not measured
    covariances: Floats  # (n, 3, 3) in mm^2
    rotations: Floats | None = None  # (n, 3, 3) of the body, if they are measured too
    pose_covariances: Floats | None = None  # (n, 6, 6) in the `perturb` chart, then

    def measured(self) -> PoseTrack:
        """The rows in which a pose was measured."""
        rows = np.isfinite(self.positions_mm).all(axis=1)
        arrays = {
            name: value[rows]
            for name, value in vars(self).items()
            if name != "name" and value is not None
        }
        return replace(self, **arrays)

    def inverted(self) -> PoseTrack:
        """body_from_world instead of world_from_body; rotations must be measured."""
        table = self.table()
        poses, P = inverted(table.world_from_body, table.covariances)
        return PoseTrack(
            self.name, self.times_s, poses.translation, P[:, :3, :3], poses.rotation, P
        )

    def table(self) -> PoseTable:
        """The same with rotations, which must be measured."""
        assert self.rotations is not None
        assert self.pose_covariances is not None
        poses = RigidTransform(self.rotations, self.positions_mm)
        return PoseTable(self.times_s, poses, self.pose_covariances)


@dataclass(frozen=True)
class AssemblySettings:
    """How poses and states are paired.

    Attributes:
        clock_offset_s: robot time minus camera time, if known.
        largest_offset_s: search the offset within plus and minus this.
        history_hz: add unlabelled states between the labels at this rate.
        cut_s: cut recordings into trajectories of this length.
        largest_sd_mm: do not learn from labels less certain than this.
        outlier_sds: nor from labels so many robust SDs from their neighbours' median; inf uses all.
        as_it_is: keep labels that a frame, a tool or a clock explains, with a warning.
    """

    clock_offset_s: float | None = None
    largest_offset_s: float = 5.0
    history_hz: float = 0.0
    cut_s: float = 0.0
    largest_sd_mm: float = 3.0
    outlier_sds: float = 6.0
    as_it_is: bool = False

    def __post_init__(self) -> None:
        for name in ("largest_offset_s", "largest_sd_mm", "history_hz", "cut_s"):
            value = getattr(self, name)
            if not (value >= 0 and np.isfinite(value)):
                raise EstimatorError(f"{name} is {value:g}: expected a number that is not negative")
        if not self.outlier_sds > 0:
            raise EstimatorError(f"outlier_sds is {self.outlier_sds:g}: expected a number above 0")
        if self.history_hz > _LARGEST_RATE_HZ:
            raise EstimatorError(
                f"history_hz is {self.history_hz:g}: expected {_LARGEST_RATE_HZ:g} at most"
            )
        if self.clock_offset_s is not None and not np.isfinite(self.clock_offset_s):
            raise EstimatorError(f"clock_offset_s is {self.clock_offset_s:g}: expected a number")
        if self.largest_offset_s > _LARGEST_OFFSET_S:
            raise EstimatorError(
                f"largest_offset_s is {self.largest_offset_s:g}: the search goes up to "
                f"{_LARGEST_OFFSET_S:g} s; bring the log nearer to the recording"
            )


@dataclass(frozen=True)
class TrajectoryFacts:
    """Counts of one recording, for the data card."""

    name: str
    rows: int
    usable: int
    not_measured: int
    no_state: int
    outliers: int
    uncertain: int
    bad_states: int
    duration_s: float
    clock: ClockOffset | None = field(default=None)
    doubts: tuple[str, ...] = ()  # why the labels may be no errors of the robot


def assemble(
    pairs: Sequence[tuple[PoseTrack, StateLog]], settings: AssemblySettings | None = None
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Pair every measured pose with the robot's state of that instant.

    States of a log that are not all numbers count as not recorded. EstimatorError: no recordings,
    clocks that do not match, positions in other units than mm or in another frame than the robot's,
    a log without numbers.
    """
    settings = settings or AssemblySettings()
    if not pairs:
        raise EstimatorError("no recordings to make a data set of")
    parts, facts = [], []
    for track, log in pairs:
        part, fact = _assemble_one(track, log, settings)
        parts.append(part)
        facts.append(fact)
    return join(parts), facts


@dataclass(frozen=True, eq=False)
class _EventMarks:
    """Flags of each row (n,): pose measured, state near in time, outlier, too uncertain."""

    measured: Bools
    near: Bools
    outlier: Bools
    uncertain: Bools

    @property
    def usable(self) -> Bools:
        """Rows whose label is used for training."""
        return self.measured & self.near & ~self.uncertain & ~self.outlier

    @property
    def judged(self) -> Bools:
        """Rows that tell whether labels are errors: not outliers, unless most are.

        In a wrong frame labels jump as outliers do.
        """
        sure = self.measured & self.near & ~self.uncertain
        return sure if 2 * np.sum(sure & ~self.outlier) < np.sum(sure) else sure & ~self.outlier

    @property
    def kept(self) -> Bools:
        """Rows of the data set, with or without a usable label."""
        return self.near | self.measured


def _assemble_one(
    track: PoseTrack, log: StateLog, settings: AssemblySettings
) -> tuple[Dataset, TrajectoryFacts]:
    finite = complete_states(track.name, log)
    check_rate(track.name, finite)
    clock = _clock(track, finite, settings)
    offset = clock.offset_s if clock else settings.clock_offset_s or 0.0
    times, row_of_pose = _row_times(track.times_s + offset, finite, settings.history_hz)
    states, near = interpolate(finite, times, LONGEST_GAP_S)
    positions, covariances = _measured_at(track, row_of_pose, len(times))
    reported = log.schema.position_mm(states)
    errors = positions - reported
    measured = np.asarray(np.isfinite(errors).all(axis=1))
    common = measured & near
    if not common.any():
        raise _nothing_common(track, finite, offset)
    check_units(track.name, positions[common], reported[common])
    outlier = np.zeros(len(times), dtype=bool)
    outlier[row_of_pose] = _outliers(errors[row_of_pose], settings.outlier_sds)
    sd = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    marks = _EventMarks(measured, near, outlier, measured & (sd > settings.largest_sd_mm))
    judged = marks.judged
    turns = _turns(track, log.schema, states, row_of_pose, judged, settings)
    check_frames(track.name, positions[judged], reported[judged])
    given = clock is None and bool(np.all(np.diff(times) > 0))
    rates = None
    if given:
        chain = log.schema.chain
        path = unwrapped(chain, log.schema.joint_positions(states)) if chain else reported
        rates = np.gradient(path, times, axis=0)[judged]
    doubts = label_doubts(log.schema, states[judged], errors[judged], rates, times[judged] - offset)
    check_labels(track.name, doubts, as_it_is=settings.as_it_is)
    kept = marks.kept
    trajectory, names = _cut(track.name, times[kept], settings.cut_s)
    part = Dataset(
        log.schema,
        states[kept],
        times[kept],
        trajectory,
        names,
        errors[kept],
        covariances[kept],
        marks.usable[kept],
        turns and turns[kept],
    )
    during = (log.times_s >= times[0]) & (log.times_s <= times[-1])
    bad = int((~log.complete[during]).sum())
    facts = _facts(track, marks, bad, float(times[-1] - times[0]), clock)
    return part, replace(facts, doubts=doubts)


def _measured_at(track: PoseTrack, rows: Ints, count: int) -> tuple[Floats, Floats]:
    """Positions (count, 3), NaN where none is measured, and covariances, of a track's `rows`."""
    positions = np.full((count, 3), np.nan)
    covariances = np.tile(np.eye(3), (count, 1, 1))
    positions[rows] = track.positions_mm
    covariances[rows] = np.where(np.isfinite(track.covariances), track.covariances, 1.0)
    return positions, covariances


def _turns(
    track: PoseTrack, schema: StateSchema, states: Floats, rows: Ints, judged: Bools,
    settings: AssemblySettings,
)  -> Turns | None:  # fmt: skip
    """Errors (n,) of the tip's rotation at states (n, features), of the poses in their `rows`.

    NaN where they are outliers or too uncertain, as positions are, at a lever. None where no
    rotation is known, or where it is not that of the tip. EstimatorError: rotations of the `judged`
    poses are not those of their joints' states, in any frame.
    """
    if schema.chain is None or track.rotations is None or track.pose_covariances is None:
        return None
    modelled = schema.chain.pose(schema.joint_positions(states[rows])).rotation
    judged = judged[rows]
    check_turns(track.name, track.rotations[judged], modelled[judged])
    if (cause := not_the_tip(schema, states[rows][judged], track.rotations[judged])) is not None:
        _log.warning("%s: %s", track.name, cause)
        return None
    errors, covariances = turn_errors(track.rotations, modelled), track.pose_covariances[:, 3:, 3:]
    errors[~np.isfinite(track.positions_mm).all(axis=1)] = np.nan
    sd_mm = LEVER_MM * np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    certain = sd_mm <= settings.largest_sd_mm
    errors[~certain | _outliers(LEVER_MM * errors, settings.outlier_sds, _LEAST_JUMP_MM)] = np.nan
    out = Turns.unknown(len(states))
    out[rows] = Turns(errors, np.where(certain[:, None, None], covariances, np.eye(3)))
    return out


@dataclass(frozen=True, eq=False)
class CompleteStates:
    """The states that are all numbers: times (n,), reported positions (n, 3), rows (n,)."""

    log: StateLog
    times_s: Floats
    reported_mm: Floats
    rows: Ints


def complete_states(name: str, log: StateLog) -> CompleteStates:
    """The log without the states that are not all numbers."""
    good = log.complete
    if good.sum() < 2:
        worst = int(log.broken.argmax())
        raise EstimatorError(
            f"{name}: the robot's log has {int(good.sum())} states that are all numbers; feature "
            f"'{log.schema.names[worst]}' is none in {int(log.broken[worst])} of {len(good)}"
        )
    kept = slice(None) if good.all() else good  # a copy of a long log is large
    return CompleteStates(log, log.times_s[kept], log.reported_mm[kept], np.flatnonzero(good))


def _clock(track: PoseTrack, log: CompleteStates, settings: AssemblySettings) -> ClockOffset | None:
    """The offset estimated from the motion, or None if it was given."""
    seen = np.isfinite(track.positions_mm).all(axis=1)
    if seen.sum() < 10:
        raise EstimatorError(f"{track.name}: only {int(seen.sum())} poses were measured")
    if settings.clock_offset_s is not None:
        return None
    return estimate_offset(
        track.times_s[seen],
        track.positions_mm[seen],
        log.times_s,
        log.reported_mm,
        largest_s=settings.largest_offset_s,
    )


def _nothing_common(track: PoseTrack, log: CompleteStates, offset_s: float) -> EstimatorError:
    first, last = track.times_s[[0, -1]] + offset_s
    return EstimatorError(
        f"{track.name}: no pose has a state: on the robot's clock, at an offset of {offset_s:g} s, "
        f"the poses run from {first:.1f} to {last:.1f} s and the log from "
        f"{log.times_s[0]:.1f} to {log.times_s[-1]:.1f} s"
    )


def _facts(
    track: PoseTrack,
    marks: _EventMarks,
    bad_states: int,
    duration_s: float,
    clock: ClockOffset | None,
) -> TrajectoryFacts:
    seen = np.isfinite(track.positions_mm).all(axis=1)
    return TrajectoryFacts(
        track.name,
        int(marks.kept.sum()),
        int(marks.usable.sum()),
        int((~seen).sum()),
        int((marks.measured & ~marks.near).sum()),
        int(marks.outlier.sum()),
        int(marks.uncertain.sum()),
        bad_states,
        duration_s,
        clock,
    )


def _row_times(pose_times: Floats, log: CompleteStates, history_hz: float) -> tuple[Floats, Ints]:
    if history_hz <= 0:
        return pose_times, np.arange(len(pose_times))
    start, stop = max(pose_times[0], log.times_s[0]), min(pose_times[-1], log.times_s[-1])
    times = np.union1d(pose_times, np.arange(start, stop, 1.0 / history_hz))
    return times, np.searchsorted(times, pose_times)


def interpolate(log: CompleteStates, at: Floats, longest_gap_s: float) -> tuple[Floats, Bools]:
    """States (n, features) at instants (n,), and whether the log has one as near as that.

    By cubics through neighbouring states (Catmull and Rom 1974): ten states a second of a fast arm
    bend by a millimetre between two of them.
    """
    right = np.clip(np.searchsorted(log.times_s, at), 1, len(log.times_s) - 1)
    rows = np.clip(right[:, None] + np.arange(-2, 2), 0, len(log.times_s) - 1)
    times = log.times_s[rows]
    before, after = times[:, 1], times[:, 2]
    states = log.log.states_at(log.rows[rows.ravel()]).reshape(*rows.shape, -1)
    period = log.log.schema.periods  # an angle that jumps by a turn has not moved
    turning = np.isfinite(period)
    turns = np.round((states[:, :, turning] - states[:, 1:2, turning]) / period[turning])
    states[:, :, turning] -= turns * period[turning]
    s = np.clip((at - before) / (after - before), 0.0, 1.0)
    start = (s**3 - 2 * s**2 + s) * (after - before) / (after - times[:, 0])
    end = (s**3 - s**2) * (after - before) / (times[:, 3] - before)
    rise = 3 * s**2 - 2 * s**3
    weights = np.stack([-start, 1 - rise - end, rise + start, end], axis=1)
    nearest = np.minimum(np.abs(at - before), np.abs(after - at))
    return np.einsum("nk,nkf->nf", weights, states), nearest <= longest_gap_s


def unwrapped(chain: SerialChain, joints: Floats) -> Floats:
    """Joints (n, joints) one after the other in time, angles without jumps by a turn."""
    turning = np.array([not joint.prismatic for joint in chain.joints])
    return np.where(turning, np.unwrap(joints, axis=0), joints)


def check_rate(name: str, log: CompleteStates) -> None:
    """Refuse (EstimatorError) a log between whose states the moving tip is not known."""
    way, step = log.reported_mm, float(np.median(np.diff(log.times_s)))
    if len(way) < 7 or step <= LONGEST_GAP_S:
        return
    off = rms_length(way[3:-3] - (9 * (way[2:-4] + way[4:-2]) - way[:-6] - way[6:]) / 16) / 16
    if off > _MOST_BETWEEN_MM:
        wanted_s = step * np.sqrt(0.1 * _MOST_BETWEEN_MM / off)
        raise EstimatorError(
            f"{name}: the robot's log has a state every {step:.2g} s, and between two of them the "
            f"tip is known to {off:.1f} mm (RMS) only: log at {np.ceil(1 / wanted_s):.0f} Hz or "
            "more, or let the robot stand at 8 or more places (stops)"
        )


def _outliers(errors: Floats, sds: float, least_mm: float = 1.0, window: int = 9) -> Bools:
    """Labels far from the median of their neighbours, by so much at least."""
    seen = np.isfinite(errors).all(axis=1)
    out = np.zeros(len(errors), dtype=bool)
    values = errors[seen]
    if len(values) < window:
        return out
    padded = np.pad(values, ((window // 2, window // 2), (0, 0)), mode="edge")
    neighbours = np.lib.stride_tricks.sliding_window_view(padded, window, axis=0)
    away = np.abs(values - np.median(neighbours, axis=-1))
    scale = MAD_TO_SD * np.median(away, axis=0) + 0.05
    out[np.flatnonzero(seen)[(away > np.maximum(sds * scale, least_mm)).any(axis=1)]] = True
    return out


def _cut(name: str, times: Floats, cut_s: float) -> tuple[np.ndarray, tuple[str, ...]]:
    if cut_s <= 0:
        return np.zeros(len(times), dtype=np.int64), (name,)
    piece = ((times - times[0]) // cut_s).astype(np.int64)
    piece = np.unique(piece, return_inverse=True)[1].astype(np.int64)
    return piece, tuple(f"{name}/{index:03d}" for index in range(int(piece.max()) + 1))

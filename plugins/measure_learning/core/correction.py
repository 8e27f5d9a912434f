"""Correcting recorded states with the same code that runs online."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv, parquet

from measure.arrays import Bools, Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform
from measure.host import Correction, Dataset, Turns
from measure.robots import StateSchema
from measure.tables import candidates, time_columns
from measure_learning.core import offsets
from measure_learning.core.assemble import LONGEST_GAP_S, AssemblySettings, PoseTrack, assemble
from measure_learning.core.causes import FAR_MM, chain_doubt, check_units, not_the_robot
from measure_learning.core.files import covariance_columns, turn_columns
from measure_learning.core.frames import RobotFrame
from measure_learning.core.offsets import OffsetFollower, Zeroing
from measure_learning.core.robot_model import Sightings
from measure_learning.onnx import OnnxModel
from measure_learning.robots import LogFile, check_robot, feature_columns, is_table, log_pieces
from measure_learning.robots.headings import Clock, FeatureColumns
from measure_learning.robots.tables import TableFile

_MAX_REORDERED = 100  # Largest number of packets by which a network brings one late
_MAX_LOST_IN_A_ROW = 1_000_000
"""Largest number of packets lost in a row: a quarter of an hour at 1 kHz."""
_JITTER_S = 1.0  # Largest step back of a stamp that is jitter, not a clock that was set
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest value of a feature: networks compute in float32."""
_REMEMBERED = 4096  # Corrected states whose true positions may still come
_MAX_PAUSE_S = 1000.0
"""Largest step ahead of a stamp; a longer one needs a second stamp that confirms it."""


class Refusal(StrEnum):
    """Why a state got no correction."""

    MALFORMED = "malformed packet"
    FEATURE_COUNT = "wrong number of features"
    NOT_A_NUMBER = "a feature is not a number"
    REPEATED = "sequence number repeated or out of order"
    STALE = "stamp not after the last one"
    LEAP = "stamp far ahead of the last one"
    CROWDED = "too many senders"
    FAR = "true position far from the reported one"
    CONTRADICTORY = "state contradicts itself: its joints and its tip disagree"


@dataclass
class Counters:
    """Counts of states and answers."""

    corrected: int = 0  # states that got a correction
    unfamiliar: int = 0  # of these, flagged as unlike training
    lost: int = 0  # sequence numbers that never came
    unsent: int = 0
    measured: int = 0  # true positions that came in
    unanswered: int = 0  # refusals that were not sent, for strangers sent too much
    refused: Counter[Refusal] = field(default_factory=Counter)

    def refuse(self, reason: Refusal) -> Refusal:
        """Count a refusal."""
        self.refused[reason] += 1
        return reason

    def values(self) -> dict[str, int]:
        """Plain names and numbers."""
        names = ("corrected", "unfamiliar", "lost", "unsent", "unanswered", "measured")
        out = {name: getattr(self, name) for name in names}
        return out | {reason.value: self.refused[reason] for reason in Refusal}


def unfit(model: OnnxModel, state: Floats, time_s: float) -> Refusal | None:
    """Why a state is none of this model's, whatever came before it; None if it is one."""
    if len(state) != len(model.features):
        return Refusal.FEATURE_COUNT
    if np.isinf(time_s) or not (np.abs(state) <= _MAX_FLOAT32).all():
        return Refusal.NOT_A_NUMBER
    return None


class GuardedModel:
    """A model that corrects valid states, and refuses and counts all others."""

    def __init__(
        self,
        model: OnnxModel,
        zeroing: Zeroing | None = None,
        counters: Counters | None = None,
        follower: OffsetFollower | None = None,
    ) -> None:
        self.model, self.follower = model, follower
        self._recent: OrderedDict[int, tuple[Floats, float, Correction]] = OrderedDict()
        self.counters = Counters() if counters is None else counters
        self.zeroing = zeroing
        self._last_sequence: int | None = None
        self._stray_sequence: int | None = None
        self._last_time_s = self._stray_time_s = np.nan

    def update(
        self, state: Floats, time_s: float, sequence: int | None = None
    ) -> Correction | Refusal:
        """Correct a state, re-zero included, or return why it is refused.

        Args:
            time_s: its stamp, which must grow; NaN where stamps are not recorded. Two that follow
                each other, but not the last one, begin a new trajectory: a clock was set.
            sequence: its number, which must grow by one; jumps count as losses. Zero begins a
                new trajectory, the robot's program was started again; so do two numbers that
                follow each other, but not the last one.
        """
        if (reason := unfit(self.model, state, time_s)) is not None:
            return self.counters.refuse(reason)
        if sequence is not None and self._begins_anew(sequence):
            self.reset()
        reason = self._judge(time_s, sequence)
        if reason in (Refusal.STALE, Refusal.LEAP) and self._clock_was_set(time_s):
            self.reset()
        elif reason is not None:
            return self.counters.refuse(reason)
        if sequence is not None:
            if self._last_sequence is not None:
                self.counters.lost += sequence - self._last_sequence - 1
            self._last_sequence = sequence
        self._last_time_s, self._stray_time_s = time_s, np.nan
        correction = self.model.update(state, time_s)
        if correction.contradictory:
            return self.counters.refuse(Refusal.CONTRADICTORY)
        self.counters.corrected += 1
        self.counters.unfamiliar += correction.unfamiliar
        if self.zeroing is not None:
            correction = replace(
                correction,
                error_mm=correction.error_mm + self.zeroing.offset_mm(state),
                covariance=correction.covariance + self.zeroing.covariance,
            )
        if self.follower is None:
            return correction
        number = self.counters.corrected if sequence is None else sequence
        self._recent[number] = state, time_s, correction
        if len(self._recent) > _REMEMBERED:
            self._recent.popitem(last=False)
        return self.follower.corrected(correction, state, time_s)

    def measured(
        self, true_mm: Floats, covariance: Floats, sequence: int | None = None
    ) -> Correction | Refusal:
        """Take the true tip position (3,) at a corrected state, the last or one by its number.

        Gives that state's correction by now.
        """
        number = next(reversed(self._recent), None) if sequence is None else sequence
        if self.follower is None or number is None or number not in self._recent:
            return self.counters.refuse(Refusal.REPEATED)
        state, time_s, correction = self._recent[number]
        if np.linalg.norm(true_mm - self.model.schema.position_mm(state)) > FAR_MM:
            return self.counters.refuse(Refusal.FAR)
        self.follower.add(correction, state, time_s, true_mm, covariance)
        self.counters.measured += 1
        return self.follower.corrected(correction, state, time_s)

    def reset(self) -> None:
        """A new trajectory begins; counters go on."""
        self.model.reset()
        self._recent.clear()
        if self.follower is not None:
            self.follower.forget()
        self._last_sequence = self._stray_sequence = None
        self._last_time_s = self._stray_time_s = np.nan

    def _begins_anew(self, sequence: int) -> bool:
        """One number far from the last is a slip, two in a row are not (RFC 3550, A.1)."""
        if sequence == 0:
            return True
        last, stray = self._last_sequence, self._stray_sequence
        near = last is None or -_MAX_REORDERED <= sequence - last <= _MAX_LOST_IN_A_ROW
        self._stray_sequence = None if near else sequence
        return not near and stray is not None and 0 < sequence - stray <= _MAX_REORDERED

    def _clock_was_set(self, time_s: float) -> bool:
        """Whether two stamps in a row are far from the last and follow each other."""
        stray = self._stray_time_s
        far = not -_JITTER_S <= time_s - self._last_time_s <= _MAX_PAUSE_S
        self._stray_time_s = time_s if far else np.nan
        return bool(far and 0 < time_s - stray <= _MAX_PAUSE_S)

    def _judge(self, time_s: float, sequence: int | None) -> Refusal | None:
        last = self._last_sequence
        step = 1 if sequence is None or last is None else sequence - last
        if not 0 < step <= _MAX_LOST_IN_A_ROW:
            return Refusal.REPEATED
        if time_s <= self._last_time_s:
            return Refusal.STALE
        if time_s - self._last_time_s > _MAX_PAUSE_S:
            return Refusal.LEAP
        return None


_MOST_UNLIKE, _SPARSEST = 0.5, 10.0  # share of states; their steps over those of the training
_MOST_STALE = 0.1  # share of states whose stamp is not after the last one
_UNFAMILIAR = "unfamiliar"


@dataclass(frozen=True, eq=False)
class StateTable:
    """Recorded states of one or more runs, or a piece of such a recording."""

    run: Any  # (n,) labels; the model's history restarts where they change
    index: Any  # (n,) the rows' own numbers
    times_s: Floats  # (n,) NaN where not recorded
    states: Floats  # (n, features)


@dataclass(frozen=True, eq=False)
class Corrected:
    """Estimated errors with covariances, NaN where refused; flags; what was counted."""

    errors_mm: Floats  # (n, 3)
    covariances: Floats  # (n, 3, 3) of the corrected positions, mm^2
    unfamiliar: Bools  # (n,)
    status: Any  # (n,) "corrected", "unfamiliar", or why a state was refused
    counts: dict[str, int]
    turns: Turns | None = None  # (n,) of the tip's rotation, where the model corrects it

    @property
    def axis_sd_mm(self) -> Floats:
        """SDs (n, 3) per axis."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    @property
    def sd_mm(self) -> Floats:
        """SDs (n,) in 3-D."""
        return np.asarray(np.linalg.norm(self.axis_sd_mm, axis=1))


def read_states(path: Path, model: OnnxModel) -> Iterator[StateTable]:
    """States from Parquet or CSV (columns `run`, `i` and `t_s` or `time_s` optional) or a bag.

    They come in order, piece by piece: files may be of any length. EstimatorError: features are
    missing (they are named), the states are of another robot, or the file cannot be read.
    """
    if not path.exists():
        raise EstimatorError(f"{path}: no such file of states")
    if is_table(path):
        schema = model.schema
        file = TableFile.open(path, schema.log.delimiter)
        check_robot(file, model.robot)
        return _tables(file, feature_columns(path, schema, file.schema.names))
    return _bagged(path, model)


def _bagged(path: Path, model: OnnxModel) -> Iterator[StateTable]:
    row = 0
    for times, states in log_pieces(path, model.schema):
        index = np.arange(row, row + len(times))
        yield StateTable(np.array([path.stem] * len(times)), index, times, states)
        row += len(times)


def _tables(file: TableFile, found: FeatureColumns) -> Iterator[StateTable]:
    """The last of several names of a column counts."""
    there, where, schema = file.schema.names, str(file.path), found.schema
    run = next((name for name in ("run", "trajectory") if name in file), None)
    timed = time_columns(there) or candidates(there) or schema.log.time
    clock = Clock(where, there, schema) if timed else None
    labels = [name for name in (run, "i") if name is not None and name in file]
    times = clock.columns if clock else ()
    empty = True
    for table in file.pieces((*times, *found.columns), labels):
        empty = False
        count = len(table)
        yield StateTable(
            np.array([file.path.stem] * count if run is None else table.labels(run)),
            np.arange(table.first_row, table.first_row + count)
            if "i" not in file
            else np.array(table.labels("i")),
            clock.seconds(table.numbers(*times)) if clock else np.full(count, np.nan),
            found.states(where, table.numbers(*found.columns)),
        )
    if empty:
        raise EstimatorError(f"{file.path}: holds no states")


class Corrector:
    """Streams runs through a model, from a reset each; a run may come in several tables."""

    def __init__(
        self,
        model: OnnxModel,
        zeroing: offsets.Zeroing | None = None,
        follower: offsets.OffsetFollower | None = None,
        true: PoseTrack | None = None,
        frame: RobotFrame | None = None,
    ) -> None:
        """A table of `true` positions, on the states' clock, moves the offsets of `follower`.

        With the `frame` of the labels, what it leaves open of base and tool is stated, too.
        """
        if frame is not None and frame.robot != model.robot:
            raise EstimatorError(
                f"the frame is of robot '{frame.robot}', and the model of '{model.robot}'"
            )
        self._frame = frame
        self._guarded = GuardedModel(model, zeroing, follower=follower)
        self._run: object = None
        self._true, self._next = true, 0
        self._seen = list[tuple[Floats, Floats]]()  # states, and the true positions taken there

    @property
    def counts(self) -> dict[str, int]:
        """What was counted so far."""
        return self._guarded.counters.values()

    def correct(self, table: StateTable) -> Corrected:
        """The next states; the counts are of all so far."""
        count = len(table.states)
        errors, covariances = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
        turns, status = Turns.unknown(count), list[str]()
        for row, label in enumerate(table.run.tolist()):
            if label != self._run:
                if self._true is not None and self._run is not None:
                    raise EstimatorError(
                        f"true positions belong to one run, and the states are of '{self._run}' "
                        f"and '{label}': give one run at a time"
                    )
                self._guarded.reset()
                self._run = label
            answer = self._guarded.update(table.states[row], float(table.times_s[row]))
            if isinstance(answer, Refusal):
                status.append(answer.value)
            else:
                errors[row], covariances[row] = answer.error_mm, answer.covariance
                status.append(_UNFAMILIAR if answer.unfamiliar else "corrected")
                if answer.turn is not None:
                    turns[row] = answer.turn
                self._take(table.states[row], float(table.times_s[row]))
        model = self._guarded.model
        if self._frame is not None:
            place, turn = self._frame.tip_covariances(model.schema, table.states)
            covariances += place
            turns = replace(turns, covariances=turns.covariances + turn)
        rotation, words = turns if model.turns else None, np.array(status)
        return Corrected(errors, covariances, words == _UNFAMILIAR, words, self.counts, rotation)

    def _take(self, state: Floats, time_s: float) -> None:
        """The true positions measured since the state before, where it was near in time."""
        while (
            self._true is not None
            and self._next < len(self._true.times_s)
            and self._true.times_s[self._next] <= time_s
        ):
            at, self._next = self._next, self._next + 1
            position = self._true.positions_mm[at]
            if np.isfinite(position).all() and time_s - self._true.times_s[at] <= LONGEST_GAP_S:
                self._guarded.measured(position, self._true.covariances[at])
                self._seen.append((state, position))

    def check_true(self) -> None:
        """At the end, refuse (EstimatorError) those of another clock, unit or frame."""
        if (true := self._true) is None:
            return
        if not self._seen:
            raise EstimatorError(
                f"{true.name}: none of {len(true.times_s)} true positions was measured within "
                f"{LONGEST_GAP_S:g} s before a state: they are from {true.times_s[0]:.6g} to "
                f"{true.times_s[-1]:.6g} s, on the states' clock?"
            )
        schema = self._guarded.model.schema
        states, places = map(np.array, zip(*self._seen, strict=True))
        reported = schema.position_mm(states)
        check_units(true.name, places, reported)
        joints = schema.joint_positions(states)
        seen = Sightings.of_points(places, reported, joints, schema.chain)
        if (doubt := not_the_robot(seen, schema.coupled)) is not None:
            raise EstimatorError(
                f"{true.name}: {doubt}: true positions are of the reported point, in its base"
            )


def correct_file(
    states: Path,
    model: OnnxModel,
    out: Path,
    zeroing: offsets.Zeroing | None = None,
    follower: offsets.OffsetFollower | None = None,
    true: PoseTrack | None = None,
    frame: RobotFrame | None = None,
) -> dict[str, int]:
    """Correct recorded states (see `read_states`), and count what became of them.

    Writes Parquet or CSV: `run, i, t_s`, the errors `ex, ey, ez` in mm with `sd_mm` (3-D),
    `unfamiliar` and `status`, the corrected positions `x_mm, y_mm, z_mm` with `x_sd_mm, ...`
    and their covariance in the base frame, `cov_xx_mm2, cov_xy_mm2, ... cov_zz_mm2`. Where the
    model corrects the tip's rotation: the rotation vector of its error in the base frame,
    `turn_x_rad` to `turn_z_rad`, its covariance `turn_cov_xx_rad2` to `turn_cov_zz_rad2` and,
    through the kinematics, the corrected rotation `qw, qx, qy, qz`.
    """
    corrector, schema = Corrector(model, zeroing, follower, true, frame), model.schema
    with ExitStack() as opened:
        writer: Any = None
        for table in read_states(states, model):
            reported = schema.position_mm(table.states)
            corrected = corrector.correct(table)
            rows = pa.table(
                _columns(table, corrected, reported) | _turn_columns(schema, table, corrected)
            )
            if writer is None:
                _refuse_other(states, model, table, corrected)
                kind = csv.CSVWriter if out.suffix == ".csv" else parquet.ParquetWriter
                writer = opened.enter_context(kind(out, rows.schema))
            writer.write_table(rows)
    corrector.check_true()
    return corrector.counts


def _refuse_other(path: Path, model: OnnxModel, table: StateTable, found: Corrected) -> None:
    """Refuse (EstimatorError) states of another robot, or on a clock of another unit."""
    schema, whole = model.schema, table.states[np.isfinite(table.states).all(axis=1)]
    joints, reported = schema.joint_positions(whole), schema.position_mm(whole)
    unlike = np.isin(found.status, (_UNFAMILIAR, Refusal.CONTRADICTORY.value))
    if unlike.mean() > _MOST_UNLIKE and (doubt := chain_doubt(schema.chain, joints, reported)):
        raise EstimatorError(f"{path}: its states are unlike the training, and {doubt}")
    stale = int((found.status == Refusal.STALE.value).sum())
    if stale > _MOST_STALE * len(found.status):
        raise EstimatorError(
            f"{path}: {stale} of {len(found.status)} stamps are not after the one before: sort the "
            "rows by their time"
        )
    steps = np.diff(table.times_s)
    usual_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not model.facts["memoryless"] and 0 < _SPARSEST * model.period_s < usual_s:
        raise EstimatorError(
            f"{path}: a state every {usual_s:.3g} s, and this model learnt from one every "
            f"{model.period_s:.3g} s: is the unit of the time right?"
        )


def _columns(table: StateTable, corrected: Corrected, reported_mm: Floats) -> dict[str, Any]:
    places = reported_mm + corrected.errors_mm
    return {
        "run": table.run,
        "i": table.index,
        "t_s": table.times_s,
        **{f"e{axis}": corrected.errors_mm[:, k] for k, axis in enumerate("xyz")},
        "sd_mm": corrected.sd_mm,
        "unfamiliar": corrected.unfamiliar,
        "status": corrected.status,
        **{f"{axis}_mm": places[:, k] for k, axis in enumerate("xyz")},
        **{f"{axis}_sd_mm": corrected.axis_sd_mm[:, k] for k, axis in enumerate("xyz")},
        **covariance_columns(corrected.covariances),
    }


def _turn_columns(schema: StateSchema, table: StateTable, corrected: Corrected) -> dict[str, Any]:
    columns = turn_columns(turns := corrected.turns)
    if turns is None or schema.chain is None:
        return columns
    known, quats = turns.known, np.full((len(table.states), 4), np.nan)
    pose = schema.chain.pose(schema.joint_positions(table.states[known]))
    turned = RigidTransform.from_rotvec(turns.vectors_rad[known]).rotation @ pose.rotation
    quats[known] = RigidTransform(turned, np.zeros(3)).quat_wxyz
    return columns | dict(zip(("qw", "qx", "qy", "qz"), quats.T, strict=True))


def follower_of(model: OnnxModel) -> offsets.OffsetFollower:
    """What follows the offsets by true positions."""
    return offsets.OffsetFollower(model.schema, model.facts.get("offset_sd_mm", 0.0))


def rezero(
    model: OnnxModel,
    stretch: Dataset,
    monitor: offsets.DriftMonitor | None = None,
    *,
    or_none: bool = False,
) -> tuple[offsets.Zeroing, offsets.DriftMonitor]:
    """The offsets after a restart, from a stretch measured then, and drift from its residuals.

    EstimatorError: as `fit_zeroing`, which knows `or_none`.
    """
    estimates = model.predict(stretch)
    used = stretch.usable
    residuals = (stretch.errors_mm - estimates.errors_mm)[used]
    zeroing = offsets.fit_zeroing(
        stretch.schema,
        stretch.states[used],
        residuals,
        offset_sd_mm=model.facts.get("offset_sd_mm", offsets.OFFSET_SD_MM),
        spread_sd=np.array(model.facts.get("joint_sd", [])),
        or_none=or_none,
    )
    monitor = monitor or offsets.DriftMonitor()
    stated = offsets.without_restarts(
        estimates.covariances[used], model.facts.get("offset_sd_mm", 0.0)
    )
    stated = stated + stretch.covariances[used] + zeroing.covariance
    left = residuals - zeroing.offset_mm(stretch.states[used])
    for residual, covariance in zip(left, stated, strict=True):
        monitor.add(residual, covariance)
    return zeroing, monitor


@dataclass(frozen=True, eq=False)
class RobotTraces:
    """Three positions of a robot's tip, in its base frame, at the instants of the poses."""

    times_s: Floats  # (n,) on the cameras' clock
    measured_mm: Floats  # (n, 3) by the cameras; NaN where not measured or unreliable
    reported_mm: Floats  # (n, 3) by the robot
    # (n, 3) reported plus the estimated error; NaN without a model, or where it refused.
    corrected_mm: Floats
    corrected_sd_mm: Floats  # (n,) of the correction, 3-D
    unfamiliar: Bools  # (n,) where the state is unlike the training states
    clock_offset_s: float  # robot minus camera time


def robot_traces(
    track: PoseTrack,
    log: Path,
    schema: StateSchema,
    model: OnnxModel | None = None,
    clock_offset_s: float | None = None,
) -> RobotTraces:
    """Reported, measured and corrected positions at the instants of the poses.

    The model gets every state of the log in order, as it does online; a correction holds until the
    next one. The clock offset is estimated from the motion if absent.
    """
    settings = AssemblySettings(clock_offset_s)
    data, (facts,) = assemble([(track, LogFile(log, schema))], settings)
    offset = facts.clock.offset_s if facts.clock else clock_offset_s or 0.0
    reported = data.reported_mm
    errors, sd = np.full((len(data), 3), np.nan), np.full(len(data), np.nan)
    unfamiliar = np.zeros(len(data), dtype=bool)
    if model is not None:
        model.check(schema)
        corrector = Corrector(model)
        pieces = ((table, corrector.correct(table)) for table in read_states(log, model))
        rows = [(p.times_s, c.errors_mm, c.sd_mm, c.unfamiliar) for p, c in pieces]
        times_s, *known = map(np.concatenate, zip(*rows, strict=True))
        at = np.searchsorted(times_s, data.times_s, side="right") - 1
        began = at >= 0
        for own, corrected in zip((errors, sd, unfamiliar), known, strict=True):
            own[began] = corrected[at[began]]
    measured = reported + np.where(data.usable[:, None], data.errors_mm, np.nan)
    return RobotTraces(
        data.times_s - offset, measured, reported, reported + errors, sd, unfamiliar, offset
    )

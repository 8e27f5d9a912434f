"""Accuracy of corrections: RMS, SD, reduction; per axis, trajectory, speed and without inputs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from measure.arrays import Floats, rms_length
from measure.errors import EstimatorError, FitError, MeasureError
from measure.geometry import RigidTransform, chi_square_quantile, squared_mahalanobis
from measure.host import Dataset, Estimator, Report
from measure.host.dataset import Turns, recording_of
from measure.host.interfaces import quiet
from measure.host.registry import failure
from measure_learning.onnx import Estimates, OnnxModel
from measure_learning.onnx.rotation import turn_errors

_MIN_RECORDINGS = 3  # from which on whole recordings are kept for validation and test


@dataclass(frozen=True, eq=False)
class Split:
    """Three parts that share no trajectory; validation stands for a test where there is none."""

    train: Dataset
    validation: Dataset
    test: Dataset

    @property
    def scored_on(self) -> str:
        """What the part that scores is."""
        return "validation" if self.test is self.validation else "test"


def split_by_trajectory(
    data: Dataset, *, test: float | Dataset = 0.1, validation: float = 0.1, seed: int = 0
) -> Split:
    """Choose at random until each part has its share of the usable rows.

    Neighbouring rows of a trajectory are almost the same: a random split puts one of them into
    training and the other into the test, which then measures memory, not prediction. Trajectories
    of one recording share what changes at a restart. So whole recordings are chosen where there are
    three, and whole trajectories else. EstimatorError: fewer than three trajectories with labels,
    or shares that leave nothing.
    """
    shares = [validation] if isinstance(test, Dataset) else [test, validation]
    _check_shares(*([0.1, validation] if isinstance(test, Dataset) else shares))
    counts = {name: int(data.usable[rows].sum()) for name, rows in data.runs()}
    names = [name for name, count in counts.items() if count]
    if len(names) <= len(shares):
        raise EstimatorError(
            f"{len(names)} trajector{'y' if len(names) == 1 else 'ies'} cannot be split into "
            f"training, validation{' and test' if shares[1:] else ''}: record more, or cut long "
            "recordings (--cut-s)"
        )
    order = [names[i] for i in np.random.default_rng(seed).permutation(len(names))]
    total = sum(counts.values())
    chosen: list[list[str]] = []
    for share in shares:
        units, part = _units(order), list[str]()
        while not part or (units[2:] and sum(counts[n] for n in part) < 0.75 * share * total):
            part += units.pop()
        order = [name for unit in units for name in unit]
        chosen.append(part)
    scored = test if isinstance(test, Dataset) else data.select(chosen[0])
    return Split(data.select(order), data.select(chosen[-1]), scored)


def _units(names: Sequence[str]) -> list[list[str]]:
    """What is chosen as a whole: recordings where there are three, else single trajectories."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(recording_of(name), []).append(name)
    return list(found.values()) if len(found) >= _MIN_RECORDINGS else [[name] for name in names]


def split_as_trained(data: Dataset, model: OnnxModel) -> Split:
    """The split a model was trained with, by its card; EstimatorError if the data are others."""
    parts, known = [], model.card.get("data", {})
    for what in ("training", "validation", "test"):
        facts = known.get(what, known.get("validation", {"trajectories": (), "rows": None}))
        part = data.select([name for name in data.names if name in facts["trajectories"]])
        if len(part) != facts["rows"]:
            raise EstimatorError(
                f"{model.where}: the {what} trajectories that its card names are not in these "
                "data, or cut otherwise: give all data sets it was trained on, or a --split-seed "
                "to split these anew"
            )
        parts.append(part)
    return Split(*parts)


def _check_shares(test: float, validation: float) -> None:
    if not (test > 0 and validation > 0 and test + validation < 1):
        raise EstimatorError(
            f"a test share of {test:g} and a validation share of {validation:g}: expected two "
            "above 0 that leave something to train on"
        )


def join(parts: Sequence[Dataset]) -> Dataset:
    """One data set of several of one robot with different trajectories; else EstimatorError."""
    same_robot(parts)
    names = tuple(name for part in parts for name in part.names)
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise EstimatorError(f"two recordings are called '{twice}': rename one")
    shifts = np.cumsum([0, *(len(part.names) for part in parts[:-1])])
    joined = Dataset(
        parts[0].schema,
        np.concatenate([part.states for part in parts]),
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.trajectory + s for part, s in zip(parts, shifts, strict=True)]),
        names,
        np.concatenate([part.errors_mm for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.usable for part in parts]),
    )
    if all(part.turns is None for part in parts):
        return joined
    each = [part.turns or Turns.unknown(len(part)) for part in parts]
    vectors, spreads = (np.concatenate([getattr(t, f.name) for t in each]) for f in fields(Turns))
    return replace(joined, turns=Turns(vectors, spreads))


def same_robot(parts: Sequence[Dataset]) -> None:
    """Refuse to use data of several robots, or with other features, together (EstimatorError)."""
    robots = {part.schema.robot for part in parts}
    if len(robots) > 1:
        raise EstimatorError(
            f"data of several robots cannot be used together: {', '.join(sorted(robots))}"
        )
    if not all(part.schema.means(parts[0].schema) for part in parts):
        raise EstimatorError(
            f"data of robot '{parts[0].schema.robot}' with other features, units or kinematics "
            "cannot be used together: make all of them with one description of the robot"
        )


SPEED_EDGES_MM_S = (0.0, 5.0, 15.0, 30.0, 60.0, np.inf)


@dataclass(frozen=True)
class Score:
    """Residuals of some rows, in mm."""

    rows: int
    rms_mm: float  # root mean square of the 3-D residual
    sd_mm: float  # root of the trace of the residuals' covariance
    p95_mm: float  # 95th percentile of its norm
    axis_rms_mm: tuple[float, ...]  # (3,) per axis
    axis_sd_mm: tuple[float, ...]  # (3,) per axis

    @classmethod
    def of(cls, residuals_mm: Floats) -> Score:
        """Of (n, 3) residuals."""
        if not len(residuals_mm):
            nan = float("nan")
            return cls(0, nan, nan, nan, (nan, nan, nan), (nan, nan, nan))
        axis_rms = np.sqrt((residuals_mm**2).mean(axis=0))
        axis_sd = residuals_mm.std(axis=0)
        return cls(
            len(residuals_mm),
            float(np.linalg.norm(axis_rms)),
            float(np.linalg.norm(axis_sd)),
            float(np.quantile(np.linalg.norm(residuals_mm, axis=1), 0.95)),
            tuple(axis_rms.tolist()),
            tuple(axis_sd.tolist()),
        )


@dataclass(frozen=True)
class TurnScore:
    """Errors of the tip's rotation, on the usable rows that hold it."""

    rows: int
    before_deg: float  # RMS
    after_deg: float  # RMS
    inside_95: float  # share of rows in the stated 95 % region
    consistency: float  # mean squared Mahalanobis length per axis; 1 if the covariance fits

    @classmethod
    def of(cls, data: Dataset, estimates: Estimates) -> TurnScore | None:
        """None where rotations are not measured, or not corrected."""
        if (turns := data.turns) is None or (estimated := estimates.turns) is None:
            return None
        keep = data.usable & turns.known
        if not keep.any():
            return None
        before, said = turns[keep].vectors_rad, estimated[keep]
        corrected, measured = map(RigidTransform.from_rotvec, (said.vectors_rad, before))
        left = turn_errors(measured.rotation, corrected.rotation)
        squared = squared_mahalanobis(left, said.covariances + turns[keep].covariances)
        inside = float((squared < chi_square_quantile(0.95, 3)).mean())
        before_deg, after_deg = (float(np.degrees(rms_length(one))) for one in (before, left))
        return cls(len(before), before_deg, after_deg, inside, float(squared.mean() / 3.0))


@dataclass(frozen=True)
class EstimatorEvaluation:
    """An estimator on a data set, before and after the correction."""

    before: Score  # of the reported position
    after: Score  # of the corrected position
    rms_change: float  # after / before - 1; negative is better
    sd_change: float  # the same for the SD
    # mean squared Mahalanobis length of residuals per axis; 1 if the covariance fits.
    consistency: float
    unfamiliar: float  # share of rows flagged as unlike training
    by_trajectory: dict[str, tuple[Score, Score]]  # name -> (before, after)
    # (slowest mm/s, fastest mm/s, before, after).
    by_speed: tuple[tuple[float, float, Score, Score], ...]
    turn: TurnScore | None = None  # of the tip's rotation, where it is measured and corrected


def evaluate(data: Dataset, estimates: Estimates) -> EstimatorEvaluation:
    """Score corrections, one for every row, on the usable rows of a data set."""
    keep = data.usable
    residuals = data.errors_mm - estimates.errors_mm
    before, after = Score.of(data.errors_mm[keep]), Score.of(residuals[keep])
    covariance = (estimates.covariances + data.covariances)[keep]
    squared = np.einsum("ni,nij,nj->n", residuals[keep], np.linalg.inv(covariance), residuals[keep])
    speed = speeds_mm_s(data)
    return EstimatorEvaluation(
        before=before,
        after=after,
        rms_change=after.rms_mm / before.rms_mm - 1.0,
        sd_change=after.sd_mm / before.sd_mm - 1.0 if before.sd_mm else float("nan"),
        consistency=float(squared.mean() / 3.0),
        unfamiliar=float((~(estimates.strangeness[keep] <= 1.0)).mean()),
        by_trajectory={
            name: (
                Score.of(data.errors_mm[rows][keep[rows]]),
                Score.of(residuals[rows][keep[rows]]),
            )
            for name, rows in data.runs()
        },
        by_speed=tuple(
            (low, high, Score.of(data.errors_mm[part]), Score.of(residuals[part]))
            for low, high in itertools.pairwise(SPEED_EDGES_MM_S)
            for part in [keep & (speed >= low) & (speed < high)]
        ),
        turn=TurnScore.of(data, estimates),
    )


def corrected_rms_mm(model: OnnxModel, data: Dataset) -> float:
    """RMS in mm of the usable rows' errors after a model's corrections."""
    residuals = data.errors_mm - model.predict(data).errors_mm
    return Score.of(residuals[data.usable]).rms_mm


def speed_range(low: float, high: float) -> str:
    """A range of speeds in words."""
    return f"{low:g} to {high:g}" if np.isfinite(high) else f"over {low:g}"


def speeds_mm_s(data: Dataset) -> Floats:
    """Speed of the reported position (n,); NaN where times are unknown."""
    out = np.full(len(data), np.nan)
    for _, rows in data.runs():
        times = data.times_s[rows]
        if len(times) > 2 and np.all(np.diff(times) > 0):
            slope = np.gradient(data.reported_mm[rows], times, axis=0)
            out[rows] = np.linalg.norm(slope, axis=1)
    return out


@dataclass(frozen=True)
class Importance:
    """Increase of the test RMS without an input."""

    name: str  # of a feature or a group of features
    features: int
    permuted_mm: float  # RMS with the columns shuffled among rows; history is shuffled with them
    removed_mm: float | None  # RMS after fitting without them; None if not tried
    permutation_mm: float  # `permuted_mm` minus the RMS with all inputs
    removal_mm: float | None  # the same of the removal


def ablate(
    model: OnnxModel,
    split: Split,
    groups: dict[str, Sequence[str]],
    *,
    refit: Callable[[], Estimator] | None = None,
    seed: int = 0,
    report: Report,
) -> tuple[float, list[Importance]]:
    """RMS in mm with all inputs, and the importance of every group of features, the largest first.

    `refit` makes an unfitted estimator; given, every group is also removed and refitted. A removed
    feature is held at its mean, so that files and schemas stay alike.
    """
    base = corrected_rms_mm(model, split.test)
    order = np.random.default_rng(seed).permutation(len(split.test))
    found = []
    for index, (name, members) in enumerate(groups.items()):
        report(index / len(groups), name)
        columns = split.test.schema.index(members)
        shuffled = split.test.states[order][:, columns]
        permuted = corrected_rms_mm(model, _with(split.test, columns, shuffled))
        removed = None if refit is None else _removed(refit(), split, columns, seed)
        removal = None if removed is None else removed - base
        found.append(Importance(name, len(columns), permuted, removed, permuted - base, removal))
    report(1.0, "done")
    return base, sorted(found, key=lambda item: -item.permutation_mm)


def field_groups(data: Dataset, *, single: bool) -> dict[str, Sequence[str]]:
    """The robot's own groups of features; where it has none, or if `single`, each that varies."""
    if data.schema.groups and not single:
        return dict(data.schema.groups)
    spread = np.ptp(data.states, axis=0)
    return {name: (name,) for name, s in zip(data.schema.names, spread, strict=True) if s > 0}


def _with(data: Dataset, columns: Sequence[int], values: Floats) -> Dataset:
    states = data.states.copy()
    states[:, columns] = values
    return replace(data, states=states, turns=None)


def _removed(estimator: Estimator, split: Split, columns: Sequence[int], seed: int) -> float:
    middle = split.train.states[:, columns].mean(axis=0)
    train, validation, test = (
        _with(part, columns, middle) for part in (split.train, split.validation, split.test)
    )
    estimator.folds = 0
    fit(estimator, train, validation, seed=seed, report=quiet)
    return corrected_rms_mm(estimator.model, test)  # type: ignore[attr-defined]


def fit(
    estimator: Estimator, data: Dataset, validation: Dataset, *, seed: int, report: Report
) -> None:
    """Fit an estimator; FitError if it fails.

    An exception raised by `report` (to end a fit, say) is raised unchanged, also where the
    estimator raises another one from it.
    """
    raised: list[BaseException] = []

    def tracked(done: float, what: str) -> None:
        share = min(max(0.0, float(done)), 1.0)
        try:
            report(share, what)
        except Exception as error:
            raised.append(error)
            raise

    try:
        estimator.fit(data, validation, seed=seed, report=tracked)
    except Exception as error:
        theirs = next((one for one in _with_causes(error) if one in raised), None)
        if theirs is None and not isinstance(error, MeasureError):
            raise FitError(str(failure("estimator", estimator, "fitting", error))) from error
        if theirs is None or theirs is error:
            raise
    else:
        return
    raise theirs


def _with_causes(error: BaseException) -> list[BaseException]:
    """An exception and what it was raised from, the latest first."""
    found: list[BaseException] = []
    at: BaseException | None = error
    while at is not None and at not in found:
        found.append(at)
        at = at.__cause__ or at.__context__
    return found

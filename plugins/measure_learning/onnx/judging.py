"""How far to trust a correction: distance from the states learnt from, and the covariance.

Both are fitted to rows that were not learnt from, of recordings left out where there are several.
What lies beyond them is bounded by what the training holds, see `Envelope`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.host.dataset import Dataset
from measure.host.interfaces import RecordingLeftOut
from measure.robots import StateSchema
from measure_learning.onnx.graph import Graph, Value
from measure_learning.onnx.kinematics import tip_place

_CLIP_SDS = 8.0  # scaled features are clipped to this many SDs
_LIMITS = 1.2, 1.35, 1.5  # distances; one is the limit; real arms err no more below 1.2
_LARGER = 1.5  # times as large residuals are a reason to call states unfamiliar
_FEWEST = 30  # rows that show how large residuals are beyond such a limit
_FARTHEST = 1.5  # the distance whose fourth power the covariance grows with: nothing shows farther
_TRAVEL_EDGE = 0.999  # quantile of the training states' travel
_FADING = 0.7  # of the travel, at each step of the training's rate
_ROUND = 3.0  # recordings' worth of offsets of one size in all directions: those of a 3-D prior
_ROUNDS, _LEAST = 12, 0.05  # of the fit of growth, and of the mean square that it may expect
_REGION_95 = 7.815  # 95 % quantile of chi squared with three degrees of freedom
_HELD, _OF_RECORDINGS = 0.9, 0.9  # labels in the region, of so many of the recordings left out
_LOST = 2.0  # distance over the limit from which nothing is known of a correction
_AGREED, _ROUNDED_MM = 0.999, 0.05  # quantile of the gaps between tip and chain; float32's share
_MARGIN = 2.0  # of that quantile: a healthy log's largest gaps are a little larger


@dataclass(frozen=True, eq=False)
class Scaling:
    """Zero mean and unit standard deviation; a feature that never varied is scaled to zero."""

    mean: Floats  # (columns,) of the training data
    sd: Floats  # (columns,) standard deviations of the training data

    @classmethod
    def of(cls, values: Floats) -> Scaling:
        """Measured on (n, columns)."""
        sd = values.std(axis=0)
        floor = 1e-6 * np.maximum(np.abs(values).max(axis=0), 1e-6)
        return cls(values.mean(axis=0), np.where(sd > floor, sd, np.inf))

    def apply(self, values: Floats) -> Floats:
        """Scaled and held within 8 SDs."""
        return np.clip((values - self.mean) / self.sd, -_CLIP_SDS, _CLIP_SDS)

    def in_graph(self, graph: Graph, x: Value) -> Value:
        """The same, as operators."""
        scaled = graph.op("Mul", graph.op("Sub", x, self.mean), 1.0 / self.sd)
        return graph.op("Clip", scaled, np.float32(-_CLIP_SDS), np.float32(_CLIP_SDS))


@dataclass(frozen=True, eq=False)
class Novelty:
    """Distances of a state from those learnt from, 1 at their edge: in range, and Mahalanobis."""

    middle: Floats
    half_range: Floats
    scaling: Scaling
    whitener: Floats

    @classmethod
    def of(cls, data: Dataset, validation: Dataset, watched: Sequence[int]) -> Novelty:
        """Of the columns `watched` only."""
        ignored = np.ones(data.states.shape[1], dtype=bool)
        ignored[list(watched)] = False
        states = np.concatenate([data.states, validation.states])
        low, high = states.min(axis=0), states.max(axis=0)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        floor = np.maximum(1e-3 * np.abs(middle), 1e-2)
        scaling = Scaling.of(data.states)
        scaling = Scaling(scaling.mean, np.where(ignored, np.inf, scaling.sd))
        scaled = scaling.apply(data.states)
        covariance = scaled.T @ scaled / len(scaled) + 0.05 * np.eye(scaled.shape[1])
        values, axes = np.linalg.eigh(covariance)
        whitener = axes / np.sqrt(values)
        distance = ((scaling.apply(states) @ whitener) ** 2).mean(axis=1)
        reach = np.where(ignored, np.inf, np.maximum(half, floor))
        edge = float(np.quantile(distance, 0.999))
        return cls(middle, reach, scaling, whitener / np.sqrt(edge))

    def in_graph(self, graph: Graph, features: Value) -> tuple[Value, Value]:
        """Both distances (N, 1)."""
        off = graph.op("Sub", features, self.middle)
        outside = graph.op("Abs", graph.op("Mul", off, 1.0 / self.half_range))
        white = graph.op("MatMul", self.scaling.in_graph(graph, features), self.whitener)
        return (
            graph.op("ReduceMax", outside, axes=[1], keepdims=1),
            graph.op("ReduceMean", graph.op("Mul", white, white), axes=[1], keepdims=1),
        )


@dataclass(frozen=True, eq=False)
class Travel:
    """How far joints (or the tip) moved lately, 1 where hardly a state learnt from moved farther.

    A kind of motion may be new where no single state is.
    """

    reading: Floats  # (features, joints) from a state to joints over the travel's edge

    @classmethod
    def of(cls, data: Dataset) -> Travel:
        """Scaled by training states."""
        reading = data.schema.reading_matrix(data.schema.joints or data.schema.position)
        reading = reading / np.maximum((data.states @ reading).std(axis=0), 1e-9)
        moved = [_faded(data.states[rows] @ reading) for _, rows in data.runs()]
        edge = float(np.quantile(np.concatenate(moved), _TRAVEL_EDGE))
        return cls(reading / max(edge, 1e-3))

    @property
    def size(self) -> int:
        """Of its memory: a started flag, the joints of the last tick, the travel until then."""
        return self.reading.shape[1] + 2

    def in_graph(
        self, graph: Graph, features: Value, memory: Value, tick: Value
    ) -> tuple[Value, Value]:
        """Travel (N, 1), fading with every tick, and the new memory."""
        sizes = graph.constant([1, self.size - 2, 1], np.int64)
        started, last, before = graph.ops("Split", 3, memory, sizes, axis=1)
        joints = graph.op("MatMul", features, self.reading)
        last = graph.mix(started, last, joints)
        moved = graph.op("ReduceL2", graph.op("Sub", joints, last), axes=[1], keepdims=1)
        travel = graph.op("Add", graph.op("Mul", before, np.float32(_FADING)), moved)
        now = graph.op("Concat", joints, travel, axis=1)
        kept = graph.mix(tick, now, graph.op("Concat", last, before, axis=1))
        return travel, graph.op("Concat", graph.ones_like(started), kept, axis=1)


def _faded(joints: Floats) -> Floats:
    """Travel (n,) of one trajectory (n, joints), as the graph computes it."""
    from scipy.signal import lfilter  # slow to load

    steps = np.linalg.norm(np.diff(joints, axis=0, prepend=joints[:1]), axis=1)
    return np.asarray(lfilter([1.0], [1.0, -_FADING], steps))


@dataclass(frozen=True, eq=False)
class Envelope:
    """What the training holds, beyond which nothing is corrected by a small stated error."""

    ranges: Floats  # (features, 2) least and largest of the states
    largest_mm: float  # length of the largest label
    moment: Floats  # (3, 3) second moment of the labels, mm^2: the error of what is not corrected
    gap_mm: float | None  # largest distance of the reported tip from the chain's; None: no chain

    @classmethod
    def of(cls, data: Dataset, validation: Dataset) -> Envelope:
        """Of the training and validation trajectories."""
        states = np.concatenate([data.states, validation.states])
        labels = np.concatenate([part.errors_mm[part.usable] for part in (data, validation)])
        gap, schema = None, data.schema
        if schema.chain is not None and schema.joints:
            tips = schema.chain.tip_mm(schema.joint_positions(states))
            gaps = np.linalg.norm(schema.position_mm(states) - tips, axis=1)
            gap = _MARGIN * float(np.quantile(gaps, _AGREED)) + _ROUNDED_MM
        return cls(
            np.stack([states.min(axis=0), states.max(axis=0)], axis=1),
            float(np.linalg.norm(labels, axis=1).max()),
            labels.T @ labels / len(labels) + 1e-6 * np.eye(3),
            gap,
        )

    def contradiction(self, graph: Graph, schema: StateSchema, features: Value) -> Value:
        """(N, 1): above 1 where tip and joints disagree, NaN where a state is not all numbers."""
        total = graph.op("ReduceSum", features, graph.constant([1], np.int64), keepdims=1)
        nothing = graph.op("Mul", total, np.float32(0.0))
        if self.gap_mm is None:
            return nothing
        reported = graph.op("MatMul", features, schema.reading_matrix(schema.position))
        apart = graph.op("Sub", reported, tip_place(graph, schema, features))
        gap = graph.op("ReduceL2", apart, axes=[1], keepdims=1)
        return graph.op("Add", graph.op("Mul", gap, np.float32(1.0 / self.gap_mm)), nothing)

    def bounded(
        self, graph: Graph, error: Value, covariance: Value, strangeness: Value, sound: Value
    ) -> tuple[Value, Value]:
        """The correction (N, 3) and covariance (N, 9) that go out.

        No correction is longer than the largest label. Between once and twice the limit of
        strangeness, what is stated passes from the covariance learnt to that of a correction that
        has nothing to do with the error. Where a state is not `sound` (N, 1), nothing is corrected.
        """
        length = graph.op("ReduceL2", error, axes=[1], keepdims=1)
        share = graph.op("Div", np.array([[self.largest_mm]]), graph.op("Max", length, [[1e-6]]))
        error = graph.op("Mul", error, graph.op("Min", share, [[1.0]]))
        column, row = graph.reshape(error, -1, 3, 1), graph.reshape(error, -1, 1, 3)
        square = graph.reshape(graph.op("MatMul", column, row), -1, 9)
        unrelated = graph.op("Add", square, self.moment.reshape(1, 9))
        beyond = graph.op("Sub", strangeness, [[1.0]])
        beyond = graph.op("Mul", beyond, np.float32(1.0 / (_LOST - 1.0)))
        beyond = graph.op("Clip", beyond, np.float32(0.0), np.float32(1.0))
        covariance = graph.mix(beyond, unrelated, covariance)
        return (
            graph.op("Where", sound, error, np.zeros((1, 3))),
            graph.op("Where", sound, covariance, self.moment.reshape(1, 9)),
        )

    def kept(self, graph: Graph, near: Value, sound: Value, memory: tuple[Value, Value]) -> Value:
        """The memory after a state: none of what is not `sound`, or as `near` as nothing learnt."""
        before, after = memory
        known = graph.op("And", sound, graph.op("Less", near, [[_LOST]]))
        return graph.op("Where", known, after, before)


@dataclass(frozen=True, eq=False)
class Judged:
    """Residuals of rows that were not learnt from, and what their size may depend on."""

    errors_mm: Floats  # (n, 3) before the correction
    residuals_mm: Floats  # (n, 3) after it
    labels: Floats  # (n, 3, 3) covariances of the labels, mm^2
    ingredients: Floats  # (n, INGREDIENTS), see `ingredients_in_graph`
    strangeness: Floats  # (n,) distance from the states learnt from, 1 at their edge
    recording: Any  # (n,) names

    @classmethod
    def join(cls, parts: Sequence[Judged]) -> Judged:
        """All rows of several."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def rms_mm(self) -> tuple[float, float]:
        """RMS of the error before and after the correction."""
        before, after = (
            float(np.sqrt((one**2).sum(axis=1).mean()))
            for one in (self.errors_mm, self.residuals_mm)
        )
        return before, after

    def offsets_mm(self) -> Floats:
        """Means (recordings, 3) of the residuals."""
        names = np.unique(self.recording)
        return np.array([self.residuals_mm[self.recording == n].mean(axis=0) for n in names])

    def rows(self, keep: Bools) -> Judged:
        """Some of them."""
        return Judged(*(getattr(self, f.name)[keep] for f in fields(self)))

    def in_turn(self) -> tuple[RecordingLeftOut, ...]:
        """Every recording by the covariance that is fitted to the others."""
        names = np.unique(self.recording)
        if len(names) < 2:
            return ()
        return tuple(
            Trust.of(self.rows(self.recording != name)).judge(
                str(name), self.rows(self.recording == name)
            )
            for name in names
        )


INGREDIENTS = 3  # of the variance within a recording


def ingredients_in_graph(graph: Graph, strangeness: Value, spread: Value) -> Value:
    """(N, INGREDIENTS): one, strangeness^4, and the estimator's own variance, mm^2."""
    near = graph.op("Min", strangeness, np.array([[_FARTHEST]]))
    square = graph.op("Mul", near, near)
    ones = graph.ones_like(strangeness)
    return graph.op("Concat", ones, graph.op("Mul", square, square), spread, axis=1)


@dataclass(frozen=True, eq=False)
class Trust:
    """The covariance of a correction, and the distance beyond which a state is unfamiliar.

    It is `between`, of what is constant in a recording and changes with the day, plus `within`, of
    the rest, times the ingredients @ `growth`, none of them negative.
    """

    between: Floats  # (3, 3) mm^2
    within: Floats  # (3, 3) mm^2
    growth: Floats  # (INGREDIENTS,)
    limit: float

    @classmethod
    def of(cls, judged: Judged) -> Trust:
        """Fit the second moments of offsets and residuals, the growth, and one level of all.

        How `within` grows is what tells residuals of the same recording apart: what differs between
        recordings only (a kind of motion, say) explains nothing within one. The level is the least
        with which nine of ten recordings have nine of ten residuals in the 95 % region, and not
        below that of the residuals.
        """
        names, place, counts = np.unique(judged.recording, return_inverse=True, return_counts=True)
        weight = 1.0 / np.sqrt(counts)[place]
        weight /= weight.sum()
        offsets, count = judged.offsets_mm(), len(names)
        residual = judged.residuals_mm - offsets[place]
        between = offsets.T @ offsets / count  # its shape, of a few, is half chance
        round_ = np.trace(between) / 3.0 * np.eye(3)
        between += _ROUND / (count + _ROUND) * (round_ - between)
        noise = judged.labels.mean(axis=0)
        moment = (residual * weight[:, None]).T @ residual
        values, axes = np.linalg.eigh(moment - noise)
        floor = 0.05 * np.linalg.eigvalsh(moment).max() + 1e-6
        within = (axes * np.maximum(values, floor)) @ axes.T
        white = np.linalg.solve(within + noise, residual.T).T
        squared = (residual * white).sum(axis=1) / 3.0
        growth = _growth(squared, judged.ingredients, place, weight)
        plain = cls(between, within, growth, _limit(judged))
        squared = plain.squared(judged)
        held = [np.quantile(squared[place == one], _HELD) for one in range(count)]
        level = np.quantile(held, _OF_RECORDINGS, method="inverted_cdf") / _REGION_95
        level = max(1.0, float(level))
        return replace(plain, between=level * between, within=level * within)

    def covariances(self, ingredients: Floats) -> Floats:
        """(n, 3, 3) mm^2."""
        return self.between + (ingredients @ self.growth)[:, None, None] * self.within

    def squared(self, judged: Judged) -> Floats:
        """Squared Mahalanobis lengths (n,) of the residuals."""
        left = judged.residuals_mm[:, :, None]
        white = np.linalg.solve(self.covariances(judged.ingredients) + judged.labels, left)
        return np.asarray((left * white).sum(axis=(1, 2)))

    def judge(self, name: str, judged: Judged) -> RecordingLeftOut:
        """How this covariance fits a recording that it was not fitted to."""
        stated = np.trace(self.covariances(judged.ingredients), axis1=1, axis2=2)
        return RecordingLeftOut(
            name,
            len(stated),
            *judged.rms_mm(),
            stated_mm=float(np.sqrt(stated.mean())),
            inside_95=float((self.squared(judged) < _REGION_95).mean()),
        )

    def covariance(self, graph: Graph, ingredients: Value) -> Value:
        """(N, 9)."""
        scale = graph.op("MatMul", ingredients, self.growth[:, None])
        return graph.affine(scale, self.within.reshape(1, 9), self.between.reshape(1, 9))


def _growth(squared: Floats, ingredients: Floats, place: Ints, weight: Floats) -> Floats:
    """Factors of ingredients (n, k), of mean squares per axis whose level is a recording's.

    Iterated least squares: what is expected to be large varies as much more.
    """
    from scipy.optimize import nnls  # slow to load

    squared = np.minimum(squared, np.quantile(squared, 0.99))  # outliers of labels
    expected, root = np.ones(len(squared)), np.sqrt(weight)
    mass = np.bincount(place, weight)
    level = np.ones(len(mass))
    for _ in range(_ROUNDS):
        scale = (root / expected)[:, None]
        growth, _ = nnls(ingredients * scale, squared / level[place] * scale[:, 0])
        expected = np.maximum(ingredients @ growth, _LEAST)
        level = np.maximum(np.bincount(place, weight * squared / expected) / mass, _LEAST)
    mean, least = float(weight @ (ingredients @ growth)), np.eye(len(growth))[0]
    return least if mean <= 0 else np.asarray((1.0 - _LEAST) * growth / mean + _LEAST * least)


def _limit(judged: Judged) -> float:
    """The least distance beyond which residuals are clearly larger, or nothing is known of them."""
    squared = (judged.residuals_mm**2).sum(axis=1)
    for edge in _LIMITS:
        beyond = judged.strangeness > edge
        if beyond.sum() < _FEWEST or beyond.all():
            return edge
        if squared[beyond].mean() > _LARGER**2 * squared[~beyond].mean():
            return edge
    return _LIMITS[-1]


UNJUDGED = Trust(np.zeros((3, 3)), np.eye(3), np.eye(INGREDIENTS)[0], 1.0)

"""How far to trust a correction: distance from the states learnt from, and the covariance.

Both are fitted to rows that were not learnt from, of recordings left out where there are several.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from measure.arrays import Bools, Floats, Ints
from measure.host.dataset import Dataset
from measure.host.estimator import RecordingLeftOut
from measure_learning.onnx.graph import Graph, Value

_CLIP_SDS = 8.0  # scaled features are clipped to this many SDs
_LIMITS = 1.2, 1.35, 1.5  # distances of which one is the limit; real arms err no more below 1.2
_LARGER = 1.5  # times as large residuals are a reason to call states unfamiliar
_FEWEST = 30  # rows that show how large residuals are beyond such a limit
_FARTHEST = 1.5  # the distance whose fourth power the covariance grows with: nothing shows farther
_VARIANCE_MM2 = 0.01  # added to an estimator's own variance, of which the logarithm is taken
_TRAVEL_EDGE = 0.999  # quantile of the training states' travel
_FADING = 0.7  # of the travel, at each step of the training's rate
_ROUND = 3.0  # recordings' worth of offsets of one size in all directions: those of a 3-D prior
_ROUNDS, _LEAST = 12, 0.05  # of the fit of growth, and of the mean square that it may expect
_SMALL, _RIDGE = 0.1, 0.1  # of the mean square, added to each; of the regression's mean diagonal
_MOST_TILT = 1.0  # of the logarithm by which residuals are told apart within a recording
_REGION_95 = 7.815 / 3.0  # 95 % quantile of chi squared with three degrees of freedom, per axis
DOUBTS = 3  # what the covariance may depend on, see `doubts_in_graph`


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


def doubts_in_graph(graph: Graph, strangeness: Value, spread: Value, error: Value) -> Value:
    """(N, DOUBTS): strangeness^4, the log of the estimator's variance, the squared correction."""
    near = graph.op("Min", strangeness, np.array([[_FARTHEST]]))
    square = graph.op("Mul", near, near)
    size = graph.op("ReduceSumSquare", error, axes=[1], keepdims=1)
    log = graph.op("Log", graph.op("Add", spread, np.float32(_VARIANCE_MM2)))
    return graph.op("Concat", graph.op("Mul", square, square), log, size, axis=1)


@dataclass(frozen=True, eq=False)
class Judged:
    """Residuals of rows that were not learnt from, and what their size may depend on."""

    errors_mm: Floats  # (n, 3) before the correction
    residuals_mm: Floats  # (n, 3) after it
    labels: Floats  # (n, 3, 3) covariances of the labels, mm^2
    doubts: Floats  # (n, DOUBTS)
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


@dataclass(frozen=True, eq=False)
class Tilt:
    """A factor of the covariance that tells residuals of one recording apart, by the doubts."""

    scaling: Scaling
    slopes: Floats  # (DOUBTS,) of the factor's logarithm

    @classmethod
    def of(cls, judged: Judged, place: Ints, weight: Floats) -> Tilt:
        """Ridge regression of log squared residuals, each recording less its mean."""
        scaling = Scaling.of(judged.doubts)
        squared = (judged.residuals_mm**2).sum(axis=1)
        x = _less_means(scaling.apply(judged.doubts), place)
        level = squared - _less_means(squared[:, None], place)[:, 0]
        y = _less_means(np.log(squared + _SMALL * level + 1e-12)[:, None], place)[:, 0]
        normal = (x * weight[:, None]).T @ x
        normal += (_RIDGE * np.trace(normal) / len(normal) + 1e-12) * np.eye(len(normal))
        return cls(scaling, np.asarray(np.linalg.solve(normal, x.T @ (weight * y)), np.float64))

    def factor(self, doubts: Floats) -> Floats:
        """(n,)."""
        log = self.scaling.apply(doubts) @ self.slopes
        return np.asarray(np.exp(np.clip(log, -_MOST_TILT, _MOST_TILT)))

    def in_graph(self, graph: Graph, doubts: Value) -> Value:
        """(N, 1)."""
        log = graph.op("MatMul", self.scaling.in_graph(graph, doubts), self.slopes[:, None])
        low, high = np.float32(-_MOST_TILT), np.float32(_MOST_TILT)
        return graph.op("Exp", graph.op("Clip", log, low, high))


def _less_means(values: Floats, place: Ints) -> Floats:
    """Values (n, k) less those of their recordings (n,), on average."""
    out = values.copy()
    for one in range(place.max() + 1):
        out[place == one] -= values[place == one].mean(axis=0)
    return out


@dataclass(frozen=True, eq=False)
class Trust:
    """The covariance of a correction, and the distance beyond which a state is unfamiliar.

    The covariance is `moment` times (1, strangeness^4) @ `growth`, both >= 0, times that of `tilt`.
    """

    moment: Floats
    growth: Floats
    tilt: Tilt
    limit: float

    @classmethod
    def of(cls, judged: Judged) -> Trust:
        """Fit what tells residuals apart, their second moment less the labels', and its growth.

        Recordings differ by more than their states show, so each has a level of its own while
        `tilt` and `growth` are fitted: what differs between them only (a kind of motion, say)
        explains nothing within one. Then one level is taken: that of the residuals, or a higher one
        where the 95 % region would hold less than 95 % of them (split conformal), recordings
        counting by the root of their labels.
        """
        names, place, counts = np.unique(judged.recording, return_inverse=True, return_counts=True)
        weight = 1.0 / np.sqrt(counts)[place]
        weight /= weight.sum()
        tilt = Tilt.of(judged, place, weight)
        residual = judged.residuals_mm / np.sqrt(tilt.factor(judged.doubts))[:, None]
        noise = judged.labels.mean(axis=0)
        moment = (residual * weight[:, None]).T @ residual
        offsets, count = judged.offsets_mm(), len(names)
        offset = offsets.T @ offsets / count  # its shape, of a few, is half chance
        round_ = np.trace(offset) / 3.0 * np.eye(3)
        moment += _ROUND / (count + _ROUND) * (round_ - offset)
        values, axes = np.linalg.eigh(moment - noise)
        floor = 0.05 * np.linalg.eigvalsh(moment).max() + 1e-6
        moment = (axes * np.maximum(values, floor)) @ axes.T
        white = np.linalg.solve(moment + noise, residual.T).T
        squared = (residual * white).sum(axis=1) / 3.0
        ingredients = np.stack([np.ones(len(residual)), judged.doubts[:, 0]], axis=1)
        growth = _growth(squared, ingredients, place, weight)
        scale = np.maximum(ingredients @ growth, _LEAST)
        growth *= max(1.0, _conformal(squared / scale, weight))
        return cls(moment, growth, tilt, _limit(judged))

    def judge(self, name: str, judged: Judged) -> RecordingLeftOut:
        """How this covariance fits a recording that it was not fitted to."""
        scale = self.growth[0] + self.growth[1] * judged.doubts[:, 0]
        scale *= self.tilt.factor(judged.doubts)
        stated = scale[:, None, None] * self.moment
        left = judged.residuals_mm
        white = np.linalg.solve(stated + judged.labels, left[:, :, None])[:, :, 0]
        errors = np.linalg.norm(left, axis=1)
        sd = np.sqrt(scale * np.trace(self.moment))
        varies = errors.std() > 0 and sd.std() > 1e-9 * sd.mean()
        return RecordingLeftOut(
            name,
            len(left),
            *judged.rms_mm(),
            stated_mm=float(np.sqrt((sd**2).mean())),
            inside_95=float(((left * white).sum(axis=1) / 3.0 < _REGION_95).mean()),
            correlation=float(np.corrcoef(sd, errors)[0, 1]) if varies else 0.0,
        )

    def covariance(self, graph: Graph, doubts: Value) -> Value:
        """(N, 9)."""
        strange = graph.columns(doubts, [0])
        scale = graph.op("Add", graph.op("Mul", strange, self.growth[1:]), self.growth[:1])
        scale = graph.op("Mul", scale, self.tilt.in_graph(graph, doubts))
        return graph.op("Mul", scale, self.moment.reshape(1, 9))


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
    mean = float(weight @ (ingredients @ growth))
    return np.asarray(growth / mean) if mean > 0 else np.eye(len(growth))[0]


def _conformal(squared: Floats, weight: Floats) -> float:
    """The factor of a covariance whose 95 % region then holds 95 % of the residuals."""
    order = np.argsort(squared)
    reached = int(np.searchsorted(np.cumsum(weight[order]), 0.95))
    return float(squared[order][min(reached, len(order) - 1)]) / _REGION_95


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


_LEVEL = Tilt(Scaling(np.zeros(DOUBTS), np.ones(DOUBTS)), np.zeros(DOUBTS))
UNJUDGED = Trust(np.eye(3), np.array([1.0, 0.0]), _LEVEL, 1.0)

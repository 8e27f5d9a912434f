"""The interface of estimators of a robot's position error."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeAlias

from measure.arrays import Floats
from measure.errors import PluginError
from measure.host.dataset import Dataset, Turns
from measure.host.interfaces import Plugin
from measure.host.settings import Settings

Report: TypeAlias = Callable[[float, str], None]
"""Progress of a fit: called often, with the share done (0 to 1) and a few words."""


def quiet(done: float, what: str) -> None:
    """A `Report` that does nothing."""
    del done, what


@dataclass(frozen=True, eq=False)
class Correction:
    """An estimated position error."""

    error_mm: Floats  # (3,) measured minus reported position; add it to the reported position
    covariance: Floats  # (3, 3) in mm^2
    # True if the state is unlike anything in training: do not rely on `error_mm`.
    unfamiliar: bool = False
    turn: Turns | None = None  # a single one, of the tip's rotation, where that was learnt
    # True if the state's joints and reported tip disagree: `error_mm` is zero.
    contradictory: bool = False


@dataclass(frozen=True)
class Epoch:
    """One point of a learning curve."""

    epoch: int  # number of passes over the data so far
    train_mm: float  # RMS error on the training trajectories, mm
    validation_mm: float  # RMS error on the validation trajectories, mm


@dataclass(frozen=True)
class RecordingLeftOut:
    """A recording that a fit has not seen, its covariance fitted to the other such recordings."""

    name: str  # of the recording
    labels: int  # how many it was judged by
    before_mm: float  # RMS error, mm
    after_mm: float  # what the fit left of it, mm
    stated_mm: float  # the SD stated of that, RMS, mm
    inside_95: float  # share of labels in the 95 % region


@dataclass(frozen=True)
class LeftOut:
    """What the covariance was fitted to."""

    recordings: int  # how many recordings there were to learn from
    # how many groups of them were left out in turn; 0 if it was fitted to validation trajectories,
    # which says nothing of a new recording where there is one only.
    groups: int
    before_mm: float  # RMS error of the rows it was fitted to, mm
    after_mm: float  # what fits without them left of it, mm
    by_recording: tuple[RecordingLeftOut, ...] = ()  # where there were two or more to leave out


class Estimator(Plugin):
    """Corrects a robot's reported position from its own state; history is kept inside."""

    curve: tuple[Epoch, ...] = ()  # how the fit went, if it was iterative
    left_out: LeftOut | None = None  # what its covariance was fitted to, if it tells
    # largest number of groups of recordings that a fit may leave out in turn to judge its
    # covariance; 0 leaves none out.
    folds: int = 4
    findings: tuple[str, ...] = ()  # what the fit found, in lines for the model card
    # a folder where a fit may keep what it has reached, and find it again.
    checkpoint: Path | None = None

    def __init__(self, config: Settings) -> None:
        self.config = config

    def after(self, first: Estimator) -> Self:
        """Learn what `first` leaves, which learns before, from the same; PluginError: it cannot."""
        raise PluginError(
            f"estimator '{self.name}' cannot learn what '{first.name}' leaves: both must be "
            "OnnxEstimators"
        )

    @abstractmethod
    def fit(self, data: Dataset, validation: Dataset, *, seed: int, report: Report) -> None:
        """Learn from `data`; choose and stop, and judge the covariance, by `validation`.

        EstimatorError: the data cannot be learnt from.

        Args:
            data: trajectories to learn from.
            validation: other trajectories of the same robot.
            seed: of everything random.
            report: to be called as the work goes on.
        """

    @abstractmethod
    def save(self, path: Path, card: Mapping[str, Any]) -> None:
        """Write one ONNX file, which `measure_learning.onnx.OnnxModel` can run.

        Args:
            card: what to store beside the network: training data, scores, revision.
        """

    @abstractmethod
    def reset(self) -> None:
        """Forget all history: a new trajectory begins."""

    @abstractmethod
    def update(self, state: Floats, time_s: float) -> Correction:
        """Take the next state (features,), ordered as in training, and estimate the error."""

"""What an estimator is: it learns a robot's position error and corrects it, state by state."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

from measure.arrays import Floats
from measure.host.interfaces import Plugin
from measure.host.settings import Settings


@dataclass(frozen=True, eq=False)
class Correction:
    """An estimated position error.

    Attributes:
        error_mm: (3,) measured minus reported position; add it to the reported position.
        covariance: (3, 3) in mm^2.
        unfamiliar: True if the state is unlike anything in training: do not rely on `error_mm`.
    """

    error_mm: Floats
    covariance: Floats
    unfamiliar: bool = False


class Estimator(Plugin):
    """Corrects a robot's reported position from its own state; history is kept inside."""

    def __init__(self, config: Settings) -> None:
        self.config = config

    @abstractmethod
    def reset(self) -> None:
        """Forget all history: a new trajectory begins."""

    @abstractmethod
    def update(self, state: Floats, time_s: float) -> Correction:
        """Take the next state (features,), ordered as in training, and estimate the error."""

"""What an estimator owes."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from measure.errors import EstimatorError
from measure.host import Correction, Estimator
from measure.testing.rules import PluginConformance, assert_covariance, assert_same


class EstimatorConformance(PluginConformance):
    """Tests of an estimator that has learnt something: override `fitted` and `states`.

    Attributes:
        plugin: the class under test.
    """

    plugin: ClassVar[type[Estimator]]

    def fitted(self) -> Estimator:
        """An instance that has learnt; it may be the same at every call."""
        raise NotImplementedError(f"{type(self).__name__} must say how to fit {self.plugin.name}")

    def states(self) -> np.ndarray:
        """States (n, features) of one trajectory like those in training, 1 ms apart."""
        raise NotImplementedError(f"{type(self).__name__} must give states to correct")

    def corrections(self, estimator: Estimator) -> list[Correction]:
        """Correct the whole trajectory."""
        return [estimator.update(state, 1e-3 * i) for i, state in enumerate(self.states())]

    def test_corrections_are_finite_with_a_covariance(self) -> None:
        """From the first state on: a control loop cannot wait."""
        estimator = self.fitted()
        estimator.reset()
        for correction in self.corrections(estimator):
            assert isinstance(correction, Correction), f"not a Correction: {correction!r}"
            assert correction.error_mm.shape == (3,), f"error of shape {correction.error_mm.shape}"
            assert np.all(np.isfinite(correction.error_mm)), f"error {correction.error_mm}"
            assert_covariance(correction.covariance, 3, "correction")

    def test_reset_forgets_all_history(self) -> None:
        """The same trajectory after a reset gives the same corrections."""
        estimator = self.fitted()
        estimator.reset()
        first = self.corrections(estimator)
        estimator.reset()
        assert_same(self.corrections(estimator), first, "corrections after reset")

    def test_it_changes_nothing_it_is_given(self) -> None:
        """The state is the robot's."""
        estimator, states = self.fitted(), self.states()
        estimator.reset()
        state = states[0].copy()
        estimator.update(state, 0.0)
        assert np.array_equal(state, states[0]), "the state was changed"

    def test_a_state_of_another_length_is_refused(self) -> None:
        """Features in another order or number would be silently wrong."""
        estimator = self.fitted()
        estimator.reset()
        try:
            estimator.update(self.states()[0][:-1], 0.0)
        except EstimatorError:
            return
        raise AssertionError("a state with a feature missing was accepted")

    def test_a_state_unlike_any_in_training_is_owned_up_to(self) -> None:
        """Far outside, or not a number: flagged or refused, never silently corrected."""
        far = self.states()[0] * 1e3 + 1e3
        broken = np.full_like(far, np.nan)
        for state in (far, broken):
            estimator = self.fitted()
            estimator.reset()
            try:
                correction = estimator.update(state, 0.0)
            except EstimatorError:
                continue
            assert correction.unfamiliar, f"state {state[:3]}... was corrected without a warning"

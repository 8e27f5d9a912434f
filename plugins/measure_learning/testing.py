"""Conformance tests of estimators."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.host import Correction, Dataset, Estimator
from measure.host.interfaces import quiet
from measure.testing.rules import PluginConformance, assert_covariance, assert_same
from measure_learning.core import AssemblySettings, Split, simulated_dataset, split_by_trajectory
from measure_learning.onnx import OnnxModel


@cache
def training_data() -> Split:
    """Two minutes of a cable-driven robot in six trajectories, split into three parts."""
    data, _ = simulated_dataset(
        minutes=2.0, pairs=720, restarts=2, seed=4, settings=AssemblySettings(cut_s=20.0)
    )
    return split_by_trajectory(data, seed=1)


class EstimatorConformance(PluginConformance):
    """Tests of an estimator fitted to two minutes of a simulated robot."""

    plugin: ClassVar[type[Estimator]]  # the class under test
    # the RMS error that may be left of the reported positions' own.
    max_rms_share: ClassVar[float] = 0.8
    _fitted: ClassVar[dict[type, Estimator]] = {}

    def fitted(self) -> Estimator:
        """A fitted instance; fitted once for all tests of a class."""
        kit = type(self)
        if kit not in self._fitted:
            estimator = self.plugin(self.config)
            estimator.fit(training_data().train, training_data().validation, seed=0, report=quiet)
            self._fitted[kit] = estimator
        return self._fitted[kit]

    def trajectory(self) -> Dataset:
        """One trajectory outside the training data."""
        test = training_data().test
        return test.select(test.present()[:1])

    def states(self) -> Floats:
        """Its states (n, features)."""
        return self.trajectory().states

    def corrections(self, estimator: Estimator) -> list[Correction]:
        """Correct the whole trajectory."""
        data = self.trajectory()
        return [
            estimator.update(state, float(time_s))
            for state, time_s in zip(data.states, data.times_s, strict=True)
        ]

    def test_corrections_are_finite_with_a_covariance(self) -> None:
        """From the first state on: a control loop cannot wait."""
        estimator = self.fitted()
        estimator.reset()
        for correction in self.corrections(estimator):
            assert isinstance(correction, Correction), f"not a Correction: {correction!r}"
            assert correction.error_mm.shape == (3,), f"error of shape {correction.error_mm.shape}"
            assert np.all(np.isfinite(correction.error_mm)), f"error {correction.error_mm}"
            assert_covariance(correction.covariance, 3, "correction")

    def test_it_corrects(self) -> None:
        """On a trajectory it has not seen, the error that is left is smaller."""
        estimator, data = self.fitted(), self.trajectory()
        estimator.reset()
        estimates = np.stack([c.error_mm for c in self.corrections(estimator)])[data.usable]
        truth = data.errors_mm[data.usable]
        share = float(np.linalg.norm(truth - estimates) / np.linalg.norm(truth))
        assert share < self.max_rms_share, f"{share:.0%} of the error is left"

    def test_the_saved_file_says_the_same(self) -> None:
        """One ONNX file, which runs without the plugin's code and carries its card."""
        estimator, data = self.fitted(), self.trajectory()
        with tempfile.TemporaryDirectory() as folder:
            estimator.save(Path(folder) / "model.onnx", {"revision": "7"})
            model = OnnxModel.load(Path(folder) / "model.onnx")
        assert model.card == {"revision": "7"}, f"the card came back as {model.card}"
        model.check(data.schema)
        model.reset()
        estimator.reset()
        for state, time_s in zip(data.states, data.times_s, strict=True):
            here, there = (e.update(state, float(time_s)) for e in (estimator, model))
            off = float(np.abs(here.error_mm - there.error_mm).max())
            assert off < 1e-3, f"the saved model differs by {off:.2g} mm"

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

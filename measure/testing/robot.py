"""The data set of a simulated robot that the kit fits estimators to."""

from __future__ import annotations

from functools import cache

from measure.learning import AssemblySettings, Split, simulated_dataset, split_by_trajectory


@cache
def training_data() -> Split:
    """Two minutes of a cable-driven robot in six trajectories, split into three parts."""
    data, _ = simulated_dataset(
        minutes=2.0, pairs=720, restarts=2, seed=4, settings=AssemblySettings(cut_s=20.0)
    )
    return split_by_trajectory(data, seed=1)

from __future__ import annotations

import pytest

from measure.host import Dataset
from measure.learning import AssemblySettings, Split, simulated_dataset, split_by_trajectory


@pytest.fixture(scope="session")
def small() -> Dataset:
    """Two minutes of the simulated RAVEN-II in six trajectories."""
    data, _ = simulated_dataset(
        minutes=2.0, pairs=720, restarts=2, seed=4, settings=AssemblySettings(cut_s=20.0)
    )
    return data


@pytest.fixture(scope="session")
def split(small: Dataset) -> Split:
    return split_by_trajectory(small, seed=1)

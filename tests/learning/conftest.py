from __future__ import annotations

from pathlib import Path

import pytest

from measure.host import Dataset
from measure.learning import (
    AssemblySettings,
    Split,
    files,
    simulated_dataset,
    split_by_trajectory,
)


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


@pytest.fixture(scope="module")
def data(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "data.parquet"
    files.write_dataset(path, small, [], "the small simulated data set")
    return path

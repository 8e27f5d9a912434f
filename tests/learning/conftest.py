from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from measure.cli import main
from measure.host import Dataset
from measure.robots import RobotLog
from measure_learning.core import (
    AssemblySettings,
    EstimateServer,
    Split,
    files,
    simulated_dataset,
    split_by_trajectory,
)
from measure_learning.robots import raven_schema, write_log
from measure_learning.simulator import simulate


@contextmanager
def serving(server: EstimateServer) -> Iterator[EstimateServer]:
    """A server that answers in a thread of its own, as long as it is needed."""
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            server.serve(0.2)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        over.set()
        thread.join()
        server.close()


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


@pytest.fixture(scope="module")
def folder(small: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set, a model trained on it, and a log of a second of the left and the right arm."""
    folder = tmp_path_factory.mktemp("refusals")
    files.write_dataset(folder / "data.parquet", small, [], "the small simulated data set")
    words = ["train", str(folder / "data.parquet"), "-o", str(folder / "model.onnx")]
    assert main([*words, "--estimator", "offset"]) == 0
    for arm in ("left", "right"):
        run = simulate(1.0, 3, log_hz=50.0, arm=arm)  # type: ignore[arg-type]
        log = RobotLog(raven_schema(arm), run.times_s, run.states)  # type: ignore[arg-type]
        write_log(folder / f"{arm}.parquet", log)
        write_log(folder / f"{arm}.csv", log)
    return folder

"""What many tests need: the shared data, the paper's body, a rig of four cameras."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

# As the command line sets it, and read when NumPy is loaded, here and in every worker: linear
# algebra of several threads beside another worker waits for itself, four times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from measure.geometry import RigidTransform
from measure.model import Ball, BallColor, Body, Camera, Intrinsics
from tests.chromium import find_chromium

pytest_plugins = ["tests.strangers"]

_CALM = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]

# A red build means a change, not a lucky draw. `pytest --hypothesis-profile=search` looks further.
settings.register_profile(
    "suite", deadline=None, derandomize=True, max_examples=25, suppress_health_check=_CALM
)
settings.register_profile("search", deadline=None, max_examples=1500, suppress_health_check=_CALM)
settings.load_profile("suite")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the hot loops before there are workers: each of them would compile them all."""
    config = session.config
    if not config.getoption("numprocesses", None) or hasattr(config, "workerinput"):
        return
    from measure.api import load_profile
    from measure.api.warming_up import warm_pipeline
    from measure.host import Registry
    from measure.simulation.catalogue import webcam_scene

    scene = webcam_scene()
    warm_pipeline(load_profile(), Registry.discover(), scene.body, scene.cameras)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What needs a browser is skipped without one."""
    if item.get_closest_marker("browser") and find_chromium() is None:
        pytest.skip("no chromium on this machine")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests come first: at the end no worker is left alone with one."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture
def signals() -> Iterator[None]:
    """Signals that end a process are as a terminal has them: `nohup`, or `&`, ignores some."""
    usual = {"SIGINT": signal.default_int_handler, "SIGTERM": signal.SIG_DFL}
    usual |= {"SIGHUP": signal.SIG_DFL} if hasattr(signal, "SIGHUP") else {}
    before = {name: signal.signal(getattr(signal, name), one) for name, one in usual.items()}
    yield
    for name, one in before.items():
        signal.signal(getattr(signal, name), one)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Data of others, which lie beside the repository: their licences let nobody copy them."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("other people's data in ../shared are not part of the project")
    return folder


@pytest.fixture(scope="session")
def renders() -> Path:
    """Path-traced sessions and a capture; `renders/README.md` says where they come from."""
    return Path(__file__).parent / "renders"


@pytest.fixture(scope="session")
def still() -> Path:
    """Twelve frame sets of rendered balls, 1/30 s apart; shared by all workers, so read-only."""
    from tests.simulated.sessions import still_session

    return still_session()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20200531)


@pytest.fixture(scope="session")
def paper_body() -> Body:
    """The paper's three balls: 20 mm in radius, 38 mm from the end effector."""
    balls = (("green", (38, 0, 0)), ("yellow", (0, 38, 0)), ("red", (-38, 0, 0)))
    return Body(
        "paper", tuple(Ball(name, BallColor.named(name), np.array(c), 20.0) for name, c in balls)
    )


@pytest.fixture(scope="session")
def webcam() -> Intrinsics:
    """A 1280x720 webcam with some distortion; its centre is not the image's."""
    matrix = [[1420.0, 0, 652.3], [0, 1417.0, 349.1], [0, 0, 1]]
    return Intrinsics((1280, 720), np.array(matrix), np.array([0.06, -0.12, 4e-4, -6e-4]))


@pytest.fixture(scope="session")
def rig(webcam: Intrinsics) -> tuple[Camera, ...]:
    """Four such webcams, 450 mm from the origin and 25 deg up, looking at it."""
    return tuple(
        Camera(f"cam{k}", webcam, looking_at_origin(450.0, np.pi / 4 + k * np.pi / 2, 0.436))
        for k in range(4)
    )


def looking_at_origin(distance_mm: float, azimuth: float, elevation: float) -> RigidTransform:
    """world_from_camera of an upright camera (x right, y down, z forward) that sees the origin."""
    level = np.cos(elevation)
    out = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    right = np.cross(-out, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(np.stack([right, np.cross(-out, right), -out], axis=1), distance_mm * out)

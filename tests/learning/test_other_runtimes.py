"""A model in C++ without Python, and in nodes of ROS by UDP: the same corrections."""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from measure.host import Dataset, Estimator, Registry
from measure.host.interfaces import quiet
from measure_learning.core import EstimateServer
from measure_learning.onnx import OnnxModel
from measure_learning.robots import find_schema
from tests.learning.conftest import serving

onnx = pytest.importorskip("onnx", reason="fitting needs the extra 'train'")

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
JOINTS = [f"q{i}" for i in range(1, 7)]


def walks(seed: int) -> Dataset:
    """A UR5e that errs by joint offsets and play-like lag, in two trajectories."""
    schema = find_schema("ur5e")
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.normal(0, 0.02, (200, 6)), axis=0) - 0.8
    tips = schema.chain.tip_mm(q)
    errors = schema.chain.tip_mm(q + 0.002) - tips + 0.05 * np.gradient(tips, axis=0)
    trajectory = np.repeat([0, 1], 100)
    return Dataset(
        schema, np.hstack([q, tips]), np.tile(np.arange(100) / 50, 2), trajectory,
        (f"a{seed}", f"b{seed}"), errors, np.tile(0.01 * np.eye(3), (200, 1, 1)),
        np.ones(200, dtype=bool),
    )  # fmt: skip


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    estimator = Registry.discover().build(Estimator, "ridge", {"play_widths": 3})
    estimator.fit(walks(1), walks(2), seed=0, report=quiet)
    path = tmp_path_factory.mktemp("model") / "ridge.onnx"
    estimator.save(path, {})
    return path


def test_the_file_says_how_it_is_run(model_path: Path) -> None:
    said, model = onnx.load(model_path).doc_string, OnnxModel.load(model_path)
    for words in (
        "`features` (N, 9)",
        f"`memory` (N, {model.memory_size})",
        "at least 0.015 s (0.75 x `period_s`, 0.02 s)",
        f"`memory_out` (N, {model.memory_size})",
    ):
        assert words in said


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, built as the page says; the library is that of the Python package."""
    if not (shutil.which("cmake") and shutil.which("c++")):
        pytest.skip("needs CMake and a C++ compiler")
    import onnxruntime

    found = list((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.1.*"))
    if not found:
        pytest.skip("this onnxruntime brings no library of its own")
    folder = tmp_path_factory.mktemp("release")
    for name in ("include", "lib"):
        (folder / name).mkdir()
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / "lib" / name).symlink_to(found[0])
    header = Path(__file__).with_name("onnxruntime_c_api.h")
    shutil.copy(header, folder / "include")
    flags = "-Wall -Wextra -Werror"
    configure = ["cmake", "-S", str(EXAMPLES / "cpp"), "-B", str(folder / "build")]
    configure += [f"-DONNXRUNTIME={folder}", f"-DCMAKE_CXX_FLAGS={flags}"]
    for words in (configure, ["cmake", "--build", str(folder / "build")]):
        subprocess.run(words, check=True, capture_output=True, timeout=200)
    return folder / "build" / "correct"


def test_cpp_gives_the_same_bits(program: Path, model_path: Path) -> None:
    data, model = walks(1), OnnxModel.load(model_path)
    states, times = data.states[:100].astype(np.float32), data.times_s[:100].copy()
    times[50:] -= 0.4 * model.period_s  # one state comes too early for a tick
    states[99] += 100.0
    lines = [
        " ".join([repr(float(t)), *(f"{number:.9g}" for number in state)])
        for t, state in zip(times, states, strict=True)
    ]
    words = [str(program), str(model_path), repr(model.period_s)]
    run = subprocess.run(
        words, input="\n".join(lines), capture_output=True, text=True, check=True, timeout=60
    )
    answers = [[float(cell) for cell in line.split()] for line in run.stdout.splitlines()]
    wanted = []
    for t, state in zip(times, states, strict=True):
        one = model.update(state, float(t))
        wanted.append([*one.error_mm, *one.covariance.ravel(), one.unfamiliar])
    np.testing.assert_array_equal(np.float32(answers), np.float32(wanted))
    assert [row[-1] for row in answers][98:] == [0.0, 1.0]
    short = subprocess.run(words, input="0.0 1.0", capture_output=True, text=True, timeout=60)
    assert short.returncode == 2
    assert short.stderr == "correct: a line has fewer than 1 + 9 numbers\n"


@pytest.fixture(scope="module")
def port(model_path: Path) -> Iterator[int]:
    with serving(EstimateServer(OnnxModel.load(model_path), ("127.0.0.1", 0))) as server:
        yield server.address[1]


class Message(SimpleNamespace):
    """A message whose parts come to be when they are filled."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


def stand_ins(parameters: dict[str, Any], sent: list[Any], heard: dict[str, Any]) -> dict[str, Any]:
    """Modules with the few names of ROS that the nodes use."""
    out = SimpleNamespace(publish=sent.append)

    class Node:
        def __init__(self, name: str) -> None: ...

        def declare_parameter(self, name: str, default: Any) -> Any:
            return SimpleNamespace(value=parameters.get(name, default))

        def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
            return out

        def create_subscription(self, kind: Any, topic: str, call: Any, quality: Any) -> None:
            heard[topic] = call

    modules = {
        "rospy": {
            "get_param": lambda name, default=None: parameters.get(name[1:], default),
            "Publisher": lambda topic, kind, queue_size: out,
            "Subscriber": lambda topic, kind, call, tcp_nodelay: heard.update({topic: call}),
        },
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": 0},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseStamped": Message, "PoseWithCovarianceStamped": Message},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"JointState": Message},
    }
    made = {name: ModuleType(name) for name in modules}
    for name, names in modules.items():
        made[name].__dict__.update(names)
    return made


@pytest.mark.parametrize("name", ["ros2_node", "ros1_node"])
def test_a_node_publishes_the_corrected_tip(
    name: str, port: int, model_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Any] = []
    heard: dict[str, Any] = {}
    for module, made in stand_ins({"joints": JOINTS, "port": port}, sent, heard).items():
        monkeypatch.setitem(sys.modules, module, made)
    monkeypatch.syspath_prepend(str(EXAMPLES / "ros"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    node = importlib.import_module(name).TipNode()
    node._corrector._socket.settimeout(5.0)
    data, model = walks(1), OnnxModel.load(model_path)
    order = [3, 1, 0, 5, 4, 2]  # a driver's, not the robot's
    for row in range(20):
        state, stamp = data.states[row].astype(np.float32), row / 50
        x, y, z = (float(value) / 1000 for value in state[6:])
        joints = Message(name=[JOINTS[i] for i in order], position=[float(state[i]) for i in order])
        joints.header.stamp = SimpleNamespace(
            sec=0, nanosec=20_000_000 * row, to_sec=lambda now=stamp: now
        )
        if row == 0:
            heard["joint_states"](joints)
            assert not sent  # no tip yet
        heard["tip"](Message(pose=Message(position=SimpleNamespace(x=x, y=y, z=z))))
        heard["joint_states"](joints)
        wanted = model.update(state, stamp)
        place = sent[-1].pose.pose.position
        moved = 1000 * np.array([place.x - x, place.y - y, place.z - z])
        np.testing.assert_allclose(moved, wanted.error_mm, atol=2e-3)
        covariance = np.reshape(sent[-1].pose.covariance, (6, 6))[:3, :3] * 1e6
        np.testing.assert_allclose(covariance, wanted.covariance, rtol=1e-3)
    assert len(sent) == 20
    heard["joint_states"](Message(name=["finger"], position=[0.1]))
    assert len(sent) == 20

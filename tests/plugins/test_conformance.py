"""Every built-in plugin passes the kit that strangers' plugins are to pass, and the kit bites."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sinks import address
from measure import testing
from measure.geometry import RigidTransform
from measure.host import Registry
from measure.model import Detection, Pose
from measure.neighbours import commands
from measure.session import formats
from measure_learning.testing import EstimatorConformance

KITS = {
    "detector": testing.DetectorConformance,
    "triangulator": testing.TriangulatorConformance,
    "solver": testing.PoseSolverConformance,
    "estimator": EstimatorConformance,
    "sink": testing.SinkConformance,
    "tracker": testing.TrackerConformance,
}


QUICK = {
    "zenoh": {"connect": "tcp/127.0.0.1:9"},  # not the network
    "gp": {"points": 200, "tuning_points": 100},
    "mlp": {"layers": (40, 30), "epochs": 60, "batch": 64, "learning_rate": 5e-3},
    "stream": {
        "perceptrons": 1, "perceptron_units": 16, "perceptron_epochs": 12, "grus": 1,
        "gru_units": 12, "gru_epochs": 40, "window": 32, "play_widths": 3,
    },
}  # fmt: skip
"""Settings with which estimators learn the kit's little data set in seconds, and sinks fit it."""


def _kit(kind: str, plugin: type) -> type:
    """A test class for one plugin, as its author would write it."""
    contents = {"plugin": plugin, "settings": QUICK.get(plugin.name, {}), "__module__": __name__}
    if kind == "sink":
        where = address(plugin.name).partition(":")[2].removeprefix("//")
        contents["address"] = where.partition("?")[0]
    return type(f"Test{plugin.__name__}", (KITS[kind],), contents)


for _item in Registry.discover().loaded:
    if _item.distribution.name == "triball" and _item.kind in KITS:
        _test_class = _kit(_item.kind, _item.plugin)
        globals()[_test_class.__name__] = _test_class
for _name, _format in formats().items():
    globals()[f"TestFormat{_name.title()}"] = type(
        f"TestFormat{_name.title()}", (testing.FormatConformance,), {"format": _format}
    )
for _name, _command in commands().items():
    if _command.package != "measure":
        globals()[f"TestCommand{_name.title()}"] = type(
            f"TestCommand{_name.title()}", (testing.CommandConformance,), {"name": _name}
        )
del _test_class  # or pytest would collect the last one twice


# -- negative controls: each of these breaks one promise, and one test must notice -----------------


def _failures(kit: type, plugin: type) -> set[str]:
    """Names of the kit's tests that a plugin fails."""
    suite = type("Control", (kit,), {"plugin": plugin, "address": "127.0.0.1:9"})()
    failed = set()
    for name in dir(suite):
        if name.startswith("test_"):
            try:
                getattr(suite, name)()
            except AssertionError:
                failed.add(name)
    return failed


def _plugin(kind: str, name: str) -> type:
    return Registry.discover().find(kind, name).plugin


class Sloppy(_plugin("triangulator", "midpoint")):  # type: ignore[misc]
    """claims too much"""

    name = "Too Sure"

    def triangulate(self, detections, cameras):
        position = super().triangulate(detections, cameras)
        return position and replace(position, covariance=position.covariance / 25)


class Remembering(_plugin("triangulator", "midpoint")):  # type: ignore[misc]
    """Averages with what it saw before."""

    name = "remembering"
    last = None

    def triangulate(self, detections, cameras):
        position = super().triangulate(detections, cameras)
        if position is not None and self.last is not None:
            position = replace(position, center=(position.center + self.last) / 2)
        self.last = None if position is None else position.center
        return position


class Meddling(_plugin("triangulator", "midpoint")):  # type: ignore[misc]
    """Rounds the detections it was lent."""

    name = "meddling"

    def triangulate(self, detections, cameras):
        for detection in detections:
            np.rint(detection.center_px, out=detection.center_px)
        return super().triangulate(detections, cameras)


class Guessing(_plugin("solver", "kabsch")):  # type: ignore[misc]
    """Answers whatever it is asked."""

    name = "guessing"

    def solve(self, positions, detections, cameras, time_s, prior=None):
        pose = super().solve(positions, detections, cameras, time_s, prior)
        if pose is not None:
            return replace(pose, flags=(), residual_mm=0.0, rms_px=0.0)
        identity = RigidTransform.identity()
        return Pose(time_s, identity, np.eye(6), 0.0, 0.0, tuple(cameras), self.body.names)


class Everywhere(_plugin("detector", "hough")):  # type: ignore[misc]
    """Sees the balls where they are expected, whatever the picture shows."""

    name = "everywhere"

    def detect(self, image, expected):
        image.pixels[0, 0] = 255
        return [
            Detection(e.ball, image.camera, 0.0, e.center_px, e.radius_px[0], -np.eye(2))
            for e in expected
        ]


class Impressed(_plugin("detector", "hough")):  # type: ignore[misc]
    """Finds the balls a pixel aside once it has been warmed up."""

    name = "impressed"
    aside_px = 0.0

    def warm_up(self):
        self.aside_px = 1.0

    def detect(self, image, expected):
        found = super().detect(image, expected)
        return [replace(d, center_px=d.center_px + self.aside_px) for d in found]


class Hopeful(_plugin("sink", "udp")):  # type: ignore[misc]
    """Takes any address, and waits for its receiver."""

    name = "hopeful"
    form = "somewhere"

    def prepare(self):
        pass

    def send(self, pose):
        time.sleep(0.01)

    def send_mark(self, mark):
        pass

    def open(self):
        pass

    def close(self):
        pass


class Grasping(_plugin("sink", "udp")):  # type: ignore[misc]
    """Takes away what it is sure of."""

    name = "grasping"
    form = "grasping:ANYWHERE"

    def send(self, pose):
        if pose.pose is not None:
            pose.pose.covariance[:] = 0.0


@pytest.mark.parametrize(
    ("kind", "plugin", "caught"),
    [
        (
            "sink",
            Hopeful,
            {
                "test_it_says_how_its_address_is_typed",
                "test_an_address_that_is_none_is_refused",
                "test_it_sends_at_once_though_nobody_listens",
            },
        ),
        ("sink", Grasping, {"test_it_sends_at_once_though_nobody_listens"}),
        (
            "triangulator",
            Sloppy,
            {
                "test_the_covariance_is_honest",
                "test_its_name_can_be_typed",
                "test_it_says_what_it_does",
            },
        ),
        ("triangulator", Remembering, {"test_it_keeps_no_state_and_changes_nothing"}),
        (
            "triangulator",
            Meddling,
            {
                "test_it_keeps_no_state_and_changes_nothing",
                "test_exact_detections_give_the_exact_centre",
            },
        ),
        (
            "solver",
            Guessing,
            {
                "test_nothing_seen_gives_none",
                "test_one_ball_gives_none",
                "test_a_body_of_another_shape_is_refused",
            },
        ),
        (
            "detector",
            Everywhere,
            {
                "test_a_picture_without_balls_gives_nothing",
                "test_flat_pictures_give_nothing",
                "test_it_changes_nothing_it_is_given",
                "test_balls_are_found_in_the_whole_frame",
            },
        ),
        ("detector", Impressed, {"test_warming_up_changes_no_answer"}),
    ],
)
def test_a_broken_promise_is_noticed(kind, plugin, caught):
    assert caught <= _failures(KITS[kind], plugin)

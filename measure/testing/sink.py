"""Conformance tests of sinks."""

from __future__ import annotations

import time
from copy import deepcopy
from typing import ClassVar

import numpy as np

from measure.errors import ConfigError
from measure.host import EventMark, SentPose, SentRun, Sink
from measure.model import Pose
from measure.testing.rules import PluginConformance, assert_same
from measure.testing.scenes import example


class SinkConformance(PluginConformance):
    """Tests of a sink that nobody listens to: it must not matter to anybody else."""

    plugin: ClassVar[type[Sink]]  # the class under test
    address: ClassVar[str]  # one that it can send to, or listen at, on this machine
    max_send_s: ClassVar[float] = 0.005  # how long sending one pose may take, median

    def build(self, address: str | None = None) -> Sink:
        """A fresh instance."""
        scene = example()
        run = SentRun("run", (scene.body,), tuple(scene.cameras.values()))
        return self.plugin(self.config, self.address if address is None else address, run)

    def poses(self) -> list[SentPose]:
        """A pose, one to doubt, one relative to another body, and one that is lost."""
        scene = example()
        variances = np.diag([0.02, 0.03, 0.05, 1e-4, 2e-4, 1e-4]) ** 2
        pose = Pose(1.0, scene.world_from_body, variances, 0.1, 0.2, ("cam0",), scene.body.names)
        name, now = scene.body.name, time.time()
        return [
            SentPose(name, "", 0, 1.0, now, now, "ok", "", pose),
            SentPose(name, "", 1, 1.1, now, now, "flagged", "the balls are far apart", pose),
            SentPose(name, "other", 1, 1.1, now, now, "ok", "", pose),
            SentPose(name, "", 2, 1.2, now, now, "lost", "too few balls", None),
        ]

    def test_it_says_how_its_address_is_typed(self) -> None:
        """`--send` lists it."""
        form = self.plugin.form
        assert form.startswith(f"{self.plugin.name}:"), f"{form!r} does not begin with its name"

    def test_an_address_that_is_none_is_refused(self) -> None:
        """When it is built, before cameras are opened."""
        for address in ("", "127.0.0.1:none"):  # some have a usual place, others take any name
            try:
                self.build(address)
            except ConfigError:
                return
        raise AssertionError("it accepts an empty address and a port that is none")

    def test_it_sends_at_once_though_nobody_listens(self) -> None:
        """Poses, marks, pictures; opened twice, closed twice, and nothing it is given changed."""
        sink, poses, took = self.build(), self.poses(), []
        before = deepcopy(poses)
        for _ in range(2):
            sink.close()
            sink.open()
            try:
                for pose in 5 * poses:
                    begun_s = time.perf_counter()
                    sink.send(pose)
                    took.append(time.perf_counter() - begun_s)
                sink.send_mark(EventMark(1.0, time.time(), "stimulus"))
                sink.send_pictures({})
            finally:
                sink.close()
        assert_same(poses, before, "poses")
        middle = float(np.median(took))
        assert middle < self.max_send_s, f"sending a pose takes {1e3 * middle:.1f} ms"

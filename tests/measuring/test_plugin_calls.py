"""Plugins that fail or answer nonsense while measuring are named, with what they did."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from measure.errors import PluginError
from measure.geometry import RigidTransform
from measure.measuring import Pipeline, Stages
from measure_plugins.pose_solvers.kabsch import KabschConfig, KabschSolver
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.tracking_rig import Oracle, run

NAN = np.array([np.nan, 0.0, 0.0])


def _each(**spoilt):
    return lambda found: [replace(one, **spoilt) for one in found]


def _fail(found):
    raise ValueError("no licence")


@pytest.mark.parametrize(
    ("plugin", "method", "spoil", "message"),
    [
        (Oracle, "detect", _fail, r"^detector 'oracle' fails \(camera 'cam\d', frame 0\): ValueE"),
        (Oracle, "detect", tuple, r"answers nonsense .*: no list but \(Detection\("),
        (Oracle, "detect", lambda found: [7], "answers nonsense .*: no Detection but 7"),
        (Oracle, "detect", _each(center_px=NAN[:2]), r"nonsense .*: \[nan, 0.0\] with the cov"),
        (
            Oracle,
            "detect",
            _each(covariance_px=np.full((2, 2), np.inf)),
            "with the covariance .*inf",
        ),
        (Oracle, "detect", _each(center_px=NAN), r"arrays of shape \(3,\) and \(2, 2\)"),
        (Oracle, "detect", _each(center_px=[1.0, 2.0]), "fails .*: AttributeError: 'list' object"),
        (Oracle, "detect", _each(ball="blue"), "a ball 'blue' in camera 'cam"),
        (Oracle, "detect", _each(radius_px=np.nan), "a radius of nan px"),
        (
            ReprojectionTriangulator,
            "triangulate_all",
            _fail,
            r"^triangulator .reprojection. of triball .* fails \(at 0.0+ s\): .* \(test_plugin_",
        ),
        (ReprojectionTriangulator, "triangulate_all", lambda found: None, "fails .*: TypeError"),
        (ReprojectionTriangulator, "triangulate_all", _each(center=NAN), "nonsense .*: .nan, 0"),
        (ReprojectionTriangulator, "triangulate_all", _each(ball="blue"), "KeyError: 'blue'"),
        (
            KabschSolver,
            "solve",
            _fail,
            r"^solver 'kabsch' of triball .* fails \(at 0.0+ s\): ValueE",
        ),
        (KabschSolver, "solve", lambda found: "here", "answers nonsense .*: no Pose but 'here'"),
        (
            KabschSolver,
            "solve",
            lambda found: replace(found, world_from_body=RigidTransform(np.eye(3), NAN)),
            "^solver 'kabsch' answers nonsense .*: .nan, 0",
        ),
        (
            KabschSolver,
            "solve",
            lambda found: replace(
                found, world_from_body=RigidTransform(np.outer(NAN, NAN), np.zeros(3))
            ),
            r"answers nonsense .*: a pose turned by \[\[nan",
        ),
    ],
)
def test_who_is_wrong_is_named(paper_body, rig, monkeypatch, plugin, method, spoil, message):
    right = getattr(plugin, method)
    monkeypatch.setattr(plugin, method, lambda *asked: spoil(right(*asked)))
    world = [(paper_body, RigidTransform.identity())]
    with pytest.raises(PluginError, match=message) as caught:
        run(paper_body, lambda time_s: world, {camera.name: camera for camera in rig}, count=1)
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize("plugin", [Oracle, ReprojectionTriangulator, KabschSolver])
def test_who_cannot_get_ready_is_named(paper_body, rig, monkeypatch, plugin):
    detectors = {rig[0].name: Oracle(paper_body, rig[0], None)}
    tracker = SimpleNamespace(warm_up=lambda: None)
    triangulator = ReprojectionTriangulator(ReprojectionConfig())
    solver = KabschSolver(KabschConfig(), paper_body)
    stages = Stages(detectors, tracker, triangulator, solver, False, False, False)
    pipeline = Pipeline(paper_body, rig, stages)
    monkeypatch.setattr(plugin, "warm_up", lambda self: 1 / 0)
    with pytest.raises(PluginError, match=rf"'{plugin.name}'.* fails \(warming up\): ZeroDivision"):
        pipeline.warm_up()

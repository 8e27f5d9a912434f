"""A pipeline whose detectors know the truth: they report it with noise, and can be made to err."""

from __future__ import annotations

import numpy as np

from measure.host import Detector, Settings
from measure.measuring import Pipeline, Stages
from measure.measuring.tracking.predictive import PredictiveTracker
from measure.measuring.tracking.settings import PredictiveConfig
from measure.model import FrameSet, Image
from measure_plugins.pose_solvers.kabsch import KabschConfig, KabschSolver
from measure_plugins.triangulators.reprojection import ReprojectionConfig, ReprojectionTriangulator
from tests.scenes import see


class Oracle(Detector):
    """Sees what `world(time_s)` says: a list of (body, pose), through the true camera."""

    name = "oracle"

    def __init__(
        self, body, camera, world, sd_px=0.1, hide=None, bias=None, sharp=True, hide_one=None
    ):
        super().__init__(Settings(), body, camera)
        self.world, self.sd_px, self.hide, self.bias = world, sd_px, hide, bias
        self.hide_one = hide_one
        self.search_sd = sd_px if sharp else 3.0
        self.searched = 0

    def detect(self, image, expected):
        rng = np.random.default_rng([image.frame, int(self.camera.name[-1])])
        windows = {e.ball: e for e in expected}
        self.searched += not windows
        out = []
        for body, pose in self.world(image.time_s):
            sd = self.sd_px if windows else self.search_sd
            for d in see({self.camera.name: self.camera}, body, pose, sd, rng, image.time_s):
                if self.hide is not None and self.hide(d.ball, self.camera.name, image.time_s):
                    continue
                if self.hide_one is not None and self.hide_one(d):
                    continue
                if not self.camera.intrinsics.contains(d.center_px[None])[0]:
                    continue
                window = windows.get(d.ball)
                if window is not None and (
                    np.linalg.norm(d.center_px - window.center_px) > window.reach_px
                    or not window.radius_px[0] <= d.radius_px <= window.radius_px[1]
                ):
                    continue
                if self.bias is not None:
                    shift = self.bias(d.ball, self.camera.name, image.time_s)
                    object.__setattr__(d, "center_px", d.center_px + shift)
                out.append(d)
        if not windows:
            return out
        nearest = {}
        for d in out:
            off = np.linalg.norm(d.center_px - windows[d.ball].center_px)
            if d.ball not in nearest or off < nearest[d.ball][0]:
                nearest[d.ball] = (off, d)
        return [d for _, d in nearest.values()]


def frame_sets(cameras, count, rate_hz=30.0, phases=None, start_s=0.0):
    """Frame sets without pixels; `phases` are the cameras' own delays in seconds."""
    for index in range(count):
        time_s = start_s + index / rate_hz
        images = {
            name: Image(name, index, time_s + (0.0 if phases is None else phases[k]), bytes)
            for k, name in enumerate(cameras)
        }
        yield FrameSet(index, time_s, images)


def run(
    body,
    world,
    true_cameras,
    count=20,
    assumed=None,
    phases=None,
    smoothing=False,
    remeasure_after_search=False,
    config=None,
    start_s=0.0,
    **oracle,
):
    """Measure `count` frame sets; returns measurements, detectors and the tracker."""
    assumed = assumed or true_cameras
    detectors = {
        name: Oracle(body, camera, world, **oracle) for name, camera in true_cameras.items()
    }
    tracker = PredictiveTracker(config or PredictiveConfig(), body, list(assumed.values()))
    stages = Stages(
        detectors=detectors,
        tracker=tracker,
        triangulator=ReprojectionTriangulator(ReprojectionConfig()),
        solver=KabschSolver(KabschConfig(), body),
        per_image_timestamps=True,
        smoothing=smoothing,
        remeasure_after_search=remeasure_after_search,
    )
    pipeline = Pipeline(body, list(assumed.values()), stages)
    measured = list(
        pipeline.measure(frame_sets(true_cameras, count, phases=phases, start_s=start_s))
    )
    return measured, detectors, tracker

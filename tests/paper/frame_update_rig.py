"""Plays the pipeline for the frame-update algorithm, with synthetic detections that can lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from measure.geometry import RigidTransform
from measure.model import FrameSet, Image
from measure.model.observations import State
from measure_paper.midpoint import MidpointSettings, MidpointTriangulator
from measure_paper.simplex import SimplexSettings, SimplexSolver
from measure_paper.tracking import FrameUpdate, FrameUpdateSettings
from tests.scenes import RAVEN, TARGET, of_ball, ring, see

CAMERAS = ring(4)
STEP_S = 1 / 30
MIDPOINT = MidpointTriangulator(MidpointSettings())


def smooth(time_s):
    """About 60 mm/s, the fastest of the paper's smooth motions."""
    shift = 20 * np.array([np.sin(3 * time_s), np.cos(3 * time_s), 0.0])
    return RigidTransform.from_rotvec([0.1, 0.2, 0.5 * time_s], TARGET + shift)


def at_rest(time_s):
    return smooth(0.0)


class Run:
    """Plays the pipeline's part, frame by frame."""

    def __init__(self, body=RAVEN, cameras=CAMERAS, motion=smooth, **settings):
        self.body, self.cameras, self.motion = body, cameras, motion
        self.real_cameras = cameras
        self.tracker = FrameUpdate(FrameUpdateSettings(**settings), body, tuple(cameras.values()))
        self.solver = SimplexSolver(SimplexSettings(), body)
        self.frame = -1
        self.expected = self.views = self.conclusion = None

    def step(self, spoil=lambda detection: detection, without=()):
        """One frame set; `spoil` changes or drops (None) detections, `without` drops cameras."""
        self.frame += 1
        time_s = self.frame * STEP_S
        names = [name for name in self.cameras if name not in without]
        images = {name: Image(name, self.frame, time_s, None) for name in names}
        frame_set = FrameSet(self.frame, time_s, images)
        self.expected = self.tracker.expect(frame_set)
        if self.expected is None:
            self.views, self.conclusion = (), None
            return self
        seen = [spoil(d) for d in see(self.real_cameras, self.body, self.motion, 0.5, None, time_s)]
        by_camera = {name: [d for d in seen if d and d.camera == name] for name in names}
        self.views = self.tracker.judge(frame_set, by_camera)
        effective = [view.detection for view in self.views if view.effective]
        positions = [
            MIDPOINT.triangulate(of_ball(effective, name), self.cameras) for name in self.body.names
        ]
        positions = [position for position in positions if position]
        pose = self.solver.solve(positions, effective, self.cameras, time_s)
        self.conclusion = self.tracker.conclude(frame_set, self.views, positions, pose, {})
        return self

    def steps(self, count, **kwargs):
        for _ in range(count):
            self.step(**kwargs)
        return self

    def view(self, ball, camera):
        return next(v for v in self.views if v.ball == ball and v.camera == camera)

    @property
    def suspended(self):
        return {(v.ball, v.camera): v.reason for v in self.views if v.state is State.SUSPENDED}


def only(ball, camera, change):
    """A spoiler of one ball in one camera."""
    return lambda d: change(d) if (d.ball, d.camera) == (ball, camera) else d


def drop(_):
    return None


def shifted(x, y):
    return lambda d: replace(d, center_px=d.center_px + np.array([x, y]))


def wrong_color(d):
    return replace(d, score=0.0, color_match=0.24)

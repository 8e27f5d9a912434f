"""A camera that drifts while a body is measured: followed in steps.

What a camera has shown lately is compared with what it showed at first. All that may be wrong with
the rig (`Evidence`) is free, but constant: only a change since then counts. It must be larger than
the displacement of balls by their shading, which differs from place to place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from measure.arrays import Floats
from measure.checking.evidence import PER_CAMERA, altered
from measure.checking.explaining import normal_equations
from measure.checking.sightings import evidence_of
from measure.geometry import chi_square_quantile
from measure.geometry.covariance import posterior_covariance, symmetric_inverse
from measure.measuring import Measurement
from measure.measuring.kept_rig import CameraChange
from measure.model import Body, Camera

_WINDOW_S, _STEP_S = 5.0, 1.0  # Length of both windows, first and latest; and between two looks
_SURE, _CLEAR = 1 - 1e-6, 16.0
"""Confidence that a camera stands elsewhere than at first, and by how much more in chi-square than
any other."""
_CAMERA_SD = [*[1e-3] * 3, *[0.5] * 3, 1e-3, 1.0, 1.0, 1e-3, 1e-3]
_SHARED_SD, _RADIUS_SD, _PLACE_SD = [1e-3, 1e-3, 0.5, 0.5, 0.5], 0.02, 0.2
"""Of what may be off all the time: each camera's parameters, those of all, and each ball's."""


class DriftWatch:
    """Where cameras stand by now against where they stood at first."""

    def __init__(self, body: Body, cameras: Sequence[Camera]) -> None:
        self._body, self._cameras, self._first = body, cameras, list[Floats]()
        self._stated = {camera.name: camera.pose_covariance for camera in cameras}
        self._latest: list[Measurement] = []
        balls = np.repeat([_RADIUS_SD, _PLACE_SD], [len(body.balls), 3 * len(body.balls)])
        known = np.concatenate([np.tile(_CAMERA_SD, len(cameras)), _SHARED_SD, balls])
        self._beforehand = known**-2.0  # Inverse variances

    def add(self, measured: Measurement, cameras: Sequence[Camera]) -> CameraChange | None:
        """Take a measurement with these cameras; gives where one of them stands now."""
        if cameras is not self._cameras:  # The window holds pictures of other poses
            self._cameras, self._latest = cameras, []
        self._latest.append(measured)
        since_s = self._latest[0].time_s
        if measured.time_s - since_s < _WINDOW_S:
            return None
        evidence = evidence_of((), (), self._latest, self._body, cameras)
        self._latest = [m for m in self._latest if m.time_s > since_s + _STEP_S]
        late = [] if evidence is None else [*normal_equations(evidence)]
        if not late or not self._first:
            self._first, self._latest = self._first or late, []
            return None
        found = [self._change(late, c) for c in range(len(cameras))]
        *_, rival, first = np.argsort([chi for _, _, chi in found])
        step, known, chi = found[first]
        if chi < chi_square_quantile(_SURE, 6) or chi - found[rival][2] < _CLEAR:
            return None
        camera = cameras[first]
        pose = altered(camera, np.pad(step, (0, PER_CAMERA - 6))).world_from_camera
        axes = np.kron([[0, 1], [1, 0]], camera.world_from_camera.rotation)
        # It drifts on: until the next step it may be off by as much.
        covariance = axes @ (known + np.outer(step, step)) @ axes.T
        if (stated := self._stated[camera.name]) is not None:
            covariance += stated
        return CameraChange(camera.name, measured.index + 1, since_s, pose, covariance)

    def _change(self, late: Sequence[Floats], camera: int) -> tuple[Floats, Floats, float]:
        """How much a camera turned and moved (6,) about its axes, its covariance, and chi-square.

        Views are as good as they state; biases of balls may be others than at first.
        """
        own = slice(PER_CAMERA * camera, PER_CAMERA * camera + 6)
        (before, right, bias), (N, r, b) = self._first, late
        follows = posterior_covariance(before + N, self._beforehand) @ N[:, own]
        noise = symmetric_inverse(N[own, own] - N[own] @ follows)
        biased = np.concatenate([b[:, own] - b @ follows, bias @ follows]) @ noise
        step, known = noise @ (r[own] - follows.T @ (right + r)), noise + biased.T @ biased
        return step, known, float(step @ symmetric_inverse(known) @ step)

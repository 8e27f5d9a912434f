"""Imported once by the fork server: what every process that is to be killed would load anew."""

from __future__ import annotations

import cv2

import measure.calibration
import measure.checking  # noqa: F401 -- to have it loaded
from measure.api import load_profile
from measure.api.warming_up import warm_pipeline
from measure.cli import main
from measure.host import Registry
from measure.simulation.catalogue import webcam_scene

__all__ = ["main", "measure"]

cv2.setNumThreads(1)  # threads do not outlive a fork
_SCENE = webcam_scene()
for _profile in ("precise", "paper"):
    warm_pipeline(load_profile(_profile), Registry.discover(), _SCENE.body, _SCENE.cameras)

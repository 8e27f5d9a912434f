"""What a pipeline is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from measure.host import Detector, PoseSolver, Triangulator
from measure.measuring.tracking import Tracker


@dataclass(frozen=True, eq=False)
class Stages:
    """The parts a pipeline is made of.

    Attributes:
        detectors: one per camera, by name.
        tracker: holds the state between frame sets.
        triangulator: locates single balls.
        solver: locates the body.
        per_image_timestamps: whether each image counts at its own time.
        smoothing: whether poses wait for later ones: one is solved again with the motion that
            those round it show, and a body just found is tracked back to where it was not.
        remeasure_after_search: whether, after a search of whole frames, the balls are measured once
            more where they were found; and whether pictures in which the body was lost are
            searched.
    """

    detectors: Mapping[str, Detector]
    tracker: Tracker
    triangulator: Triangulator
    solver: PoseSolver
    per_image_timestamps: bool
    smoothing: bool
    remeasure_after_search: bool

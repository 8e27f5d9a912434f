"""Association's loops compiled, or loaded from disk, before the first pictures arrive."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import numpy as np

from measure.errors import DegenerateGeometryError
from measure.estimation.pose_fit import Sightings, fit_pose
from measure.geometry import RigidTransform
from measure.measuring.association.candidates import by_ball, meeting_points
from measure.measuring.association.hypotheses import poses_from_triples, stack_candidates, support
from measure.measuring.association.scoring import fitting_ranges
from measure.measuring.association.second_body import signs_of_another
from measure.measuring.association.settings import AssociationSettings
from measure.model import Body, Camera, Rig


def warm_up(body: Body, cameras: Sequence[Camera]) -> None:
    """Run what a search runs, on no candidates at all."""
    settings = AssociationSettings()
    candidates = by_ball({}, body.balls, cameras)
    points = [
        meeting_points(c, settings.sigmas, settings.range_ratio, settings.max_points)
        for c in candidates
    ]
    poses_from_triples(body, points, settings.sigmas)
    nowhere = RigidTransform(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    stacked = stack_candidates(candidates, settings.sigmas, settings.extra_px)
    support(nowhere, body, cameras, stacked, settings.range_ratio)
    signs_of_another(RigidTransform.identity(), body, cameras, candidates, settings.sigmas)
    fitting_ranges(np.zeros((0, 1, 3)), np.zeros((0, 1, 3)), 1.0, 1.0)
    one = np.zeros(1, np.int64)
    sighting = Sightings(
        Rig.of(cameras[:1]), np.zeros((1, 3)), one, np.zeros((1, 2)), np.eye(2)[None], np.zeros(1)
    )
    with contextlib.suppress(DegenerateGeometryError):
        fit_pose(RigidTransform.identity(), sighting)

"""Initialisation: choosing the circles that can be the body's balls.

The paper takes the first circle of each colour and camera for effective, false ones included. Here
a circle must meet at the start what the paper asks of a suspended one: it agrees with the other
cameras' circles in 3-D, and the balls lie as far apart as in the body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from measure.arrays import Floats
from measure.measuring.tracking.paper.ray_agreement import (
    AgreementLimits,
    RayObservation,
    locate,
    misfit,
)
from measure.model import Ball, Body, Detection

_MAX_HYPOTHESES_PER_BALL = 5


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Circles that may be one ball."""

    point: Floats  # (3,) where the ball would be, mm
    members: Mapping[str, Detection]
    misfit: float  # the largest of theirs

    @property
    def quality(self) -> tuple[int, float]:
        """Sorts hypotheses, the best one highest."""
        return len(self.members), -self.misfit


def choose(
    body: Body,
    seen: Sequence[RayObservation],
    limits: AgreementLimits,
    distance_tolerance_mm: float,
) -> dict[str, Hypothesis]:
    """The best hypothesis for as many balls as possible, by ball.

    Args:
        body: its radii and its distances between balls decide.
        seen: all candidates, any number per ball and camera.
        limits: how well circles of one ball must agree.
        distance_tolerance_mm: how far the distance of two balls may be off.
    """
    offered = {ball.name: _hypotheses(ball, seen, limits) for ball in body.balls}
    best: dict[str, Hypothesis] = {}
    for chosen in _combinations(body, offered, distance_tolerance_mm):
        if _value(chosen) > _value(best):
            best = chosen
    return best


def _value(chosen: Mapping[str, Hypothesis]) -> tuple[int, int, float]:
    views = sum(len(hypothesis.members) for hypothesis in chosen.values())
    return len(chosen), views, -sum(hypothesis.misfit for hypothesis in chosen.values())


def _hypotheses(
    ball: Ball, seen: Sequence[RayObservation], limits: AgreementLimits
) -> list[Hypothesis]:
    """Every two circles of different cameras that agree, with all others that agree with them."""
    mine = [one for one in seen if one.detection.ball == ball.name]
    found: dict[frozenset[int], Hypothesis] = {}
    for first, second in combinations(mine, 2):
        if first.camera is second.camera:
            continue
        hypothesis = _grow([first, second], mine, ball.radius_mm, limits)
        if hypothesis is not None:
            found[frozenset(id(d) for d in hypothesis.members.values())] = hypothesis
    return sorted(found.values(), key=lambda h: h.quality, reverse=True)[:_MAX_HYPOTHESES_PER_BALL]


def _grow(
    seed: list[RayObservation],
    others: Sequence[RayObservation],
    radius_mm: float,
    limits: AgreementLimits,
) -> Hypothesis | None:
    point = locate(seed)
    if point is None or max(misfit(s, point, radius_mm, limits) for s in seed) > 1:
        return None
    members = list(seed)
    for name in {s.camera.name for s in others} - {s.camera.name for s in seed}:
        rivals = [s for s in others if s.camera.name == name]
        residual_flags = [misfit(s, point, radius_mm, limits) for s in rivals]
        if min(residual_flags) <= 1:
            members.append(rivals[int(np.argmin(residual_flags))])
    point = locate(members)
    if point is None:
        return None
    worst = max(misfit(s, point, radius_mm, limits) for s in members)
    if worst > 1:
        return None
    return Hypothesis(point, {s.camera.name: s.detection for s in members}, worst)


def _combinations(
    body: Body, offered: Mapping[str, Sequence[Hypothesis]], tolerance_mm: float
) -> list[dict[str, Hypothesis]]:
    """Every choice of at most one hypothesis per ball in which all distances fit the body."""
    distances = body.distances()
    chosen: list[dict[str, Hypothesis]] = [{}]
    for name in body.names:
        chosen += [
            {**before, name: hypothesis}
            for before in chosen
            for hypothesis in offered[name]
            if all(
                abs(
                    float(np.linalg.norm(hypothesis.point - other.point)) - distances[earlier, name]
                )
                <= tolerance_mm
                for earlier, other in before.items()
            )
        ]
    return chosen

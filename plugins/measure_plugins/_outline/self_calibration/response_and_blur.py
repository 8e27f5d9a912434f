"""Learning how a camera shows balls, from how well predictions look like the pictures.

Where an edge lies and what it looks like are different things: the picture across an outline is
predicted, its outline moved to fit best, and what then remains tells a wrong tone curve, a wrong
blur and the wrong kind of surface. No truth is needed, only balls in view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measure.arrays import Floats
from measure_plugins._outline.appearance.environment_map import no_room
from measure_plugins._outline.appearance.model import BENDS, GLOSSY, MATT, Appearance
from measure_plugins._outline.appearance.point_lights import no_lamps
from measure_plugins._outline.appearance.sensor import CHROMA_PX
from measure_plugins._outline.fitting.edges import LATER_STEPS, compare
from measure_plugins._outline.sampling.edge_crossing import clipped
from measure_plugins._outline.sampling.rays import CLEAR, OCCLUDED
from measure_plugins._outline.self_calibration.alignment import aligned_residuals
from measure_plugins._outline.self_calibration.patch import Sight, prediction_inputs
from measure_plugins._outline.self_calibration.specularity import highlights

_COMPARED = int(np.count_nonzero(LATER_STEPS <= 4.0))
"""Both sides of the edge; further in, highlights have their own shapes."""
_LOOKED_AT = LATER_STEPS[:_COMPARED]
_STEP = float(LATER_STEPS[1] - LATER_STEPS[0])
_STRAIGHT = np.array([1e-6, 1e-6, 1e-6, 0.15, 0.3])
_BENT = np.array([0.03, 0.1, 0.05, 0.15, 0.3])
"""How far curves (lift, bow, S) and blurs (logarithms) of cameras depart from the standard."""
BENDS_SD = _BENT[:BENDS]
_PRIOR_WEIGHT = 0.02
"""Share by which the misfit's square must fall before one such sd is believed."""
_TRIAL = np.array([0.004, 0.01, 0.006, 0.1, 0.1])
"""Steps of the numeric derivatives; that of blur is wider than the steps it is tabulated in."""
_BLUR_RANGE_PX = (0.5, 2.0)
_CHROMA_RANGE_PX = (0.3, 2.0)
_ROUNDS = 4
_ENOUGH = 5e-3
_CLEARLY_DULL = 0.02
"""Share by which mirroring the colours behind must worsen the misfit not to be believed."""
_FEWEST_RAYS = 16
_FEWEST_SIGHTS = 4
_HIGHLIT = 0.37
"""Strength of highlights above which balls are glossy. On thirty scenes it is at most 0.22 with
matt balls, and at least 0.62 with glossy ones that lamps light; satin balls and lamps as large as
windows lie between."""
_CLEARLY_GLOSSY = 0.5
_MATT_ABOVE = 0.88
_MATT_ABOVE_BENT = 0.82
"""What the glossy model leaves, as a share of what the matt one does: below the first, matt paint
need not be tried any further. Without highlights it is believed above: such glossy balls, mirroring
what is round them, have at most 0.33 and matt ones at least 0.76. Where none can be told, on white
balls, it is believed above the second (the third, where curves are bent): the glossy model, having
free reflections besides, explains matt paint nearly as well."""

Bounds = tuple[float, float]


def as_stated(now: Appearance) -> Appearance:
    """An appearance with all forgotten that a lesson teaches anew."""
    return replace(now, bends=np.zeros(BENDS), mirrors=True, lamps=no_lamps(), room=no_room())


def straight_appearance(sights: Sequence[Sight], start: Appearance, bounds: Bounds) -> Appearance:
    """Blur and surface that explain the sights, by the tone curve that `start` names."""
    return _of_either_surface(sights, start, start, _STRAIGHT, bounds)


def bent_appearance(sights: Sequence[Sight], straight: Appearance, bounds: Bounds) -> Appearance:
    """The same, and how the curve departs from the one named; `straight` without lamps."""
    bent = refined_bends(sights, straight)
    glossy, matt = (bent, straight) if straight.index == GLOSSY else (straight, bent)
    return _of_either_surface(sights, glossy, matt, _BENT, bounds)


def refined_bends(sights: Sequence[Sight], start: Appearance) -> Appearance:
    """Bends and blur that explain the sights better, by the light of the lamps that are known."""
    return _refined(sights, start, _BENT)


def left_by(one: Appearance, other: Appearance, sights: Sequence[Sight]) -> float:
    """What one leaves of the misfit's square that the other does."""
    return _share(sights, one, other) ** 2


def unclipped(sights: Sequence[Sight]) -> list[Sight]:
    """The sights without rays on which light is clipped, where enough is left."""
    return telling([_without_clipped(s) for s in sights]) or list(sights)


def surface_bounds(sights: Sequence[Sight], table: Floats) -> tuple[Bounds, Bounds]:
    """Between glossy and matt balls (see `_of_either_surface`), by the highlights that they show.

    Returns:
        For straight curves, and for bent ones.
    """
    seen = highlights([(s.pixels, s.rays.points, s.rays.status == CLEAR) for s in sights], table)
    if np.isnan(seen):
        return (_CLEARLY_GLOSSY, _MATT_ABOVE), (0.0, _MATT_ABOVE_BENT)
    least = np.inf if seen > _HIGHLIT else _CLEARLY_GLOSSY
    return (least, least), (least, least)


def with_or_without_mirroring(sights: Sequence[Sight], appearance: Appearance) -> Appearance:
    """The appearance mirroring the colours behind, unless pictures clearly show that it does not.

    A smooth surface mirrors them at grazing angles, whatever it is made of; a rough one, or one
    that only looks glossy, need not. Before a colourless background there is nothing to tell, and
    a ball before another may tell more than all the rest: what counts is how much, on average.
    """
    useful = telling(sights)
    if not useful or appearance.index != GLOSSY:
        return appearance
    does, does_not = (appearance, replace(appearance, mirrors=False, room=no_room()))
    worse = np.log([_plain_misfit(s, does) / _plain_misfit(s, does_not) for s in useful])
    return does_not if float(np.mean(worse)) > _CLEARLY_DULL else does


def _plain_misfit(sight: Sight, appearance: Appearance) -> float:
    """RMS over all clear rays: what is behind few of them tells most."""
    return float(np.sqrt(np.mean(_residuals(sight, appearance)[0] ** 2)))


def telling(sights: Sequence[Sight]) -> list[Sight]:
    """Those seen well enough to learn from; none if there are too few of them."""
    useful = [s for s in sights if np.count_nonzero(s.rays.status == CLEAR) >= _FEWEST_RAYS]
    return useful if len(useful) >= _FEWEST_SIGHTS else []


def _without_clipped(sight: Sight) -> Sight:
    """The sight without rays on which light is clipped: curves and blurs would take that up."""
    rays = sight.own_rays()
    full = clipped(sight.pixels, rays.points, rays.normals, _LOOKED_AT)
    rays.status[full & (rays.status == CLEAR)] = OCCLUDED
    return replace(sight, rays=rays)


def _of_either_surface(
    sights: Sequence[Sight],
    glossy: Appearance,
    matt: Appearance,
    prior_sd: Floats,
    bounds: Bounds,
) -> Appearance:
    """Refine an appearance of glossy and one of matt balls, and choose between them.

    Below the first of the bounds matt paint is not tried any further; above the second, believed.
    """
    glossy, matt = replace(glossy, index=GLOSSY), replace(matt, index=MATT)
    glossy = _refined(sights, glossy, prior_sd)
    if _share(sights, glossy, matt) < bounds[0]:
        return glossy
    matt = _refined(sights, matt, prior_sd)
    return matt if _share(sights, glossy, matt) > bounds[1] else glossy


def _share(sights: Sequence[Sight], one: Appearance, other: Appearance) -> float:
    """What one leaves, as a share of what the other does: geometric mean over the sights."""
    return float(np.exp(np.mean(np.log(misfits(sights, one) / misfits(sights, other)))))


def misfits(sights: Sequence[Sight], appearance: Appearance) -> Floats:
    """What each prediction leaves (m,), RMS in picture values from 0 to 1."""
    out = []
    for sight in sights:
        residuals, weights = _residuals(sight, appearance)
        out.append(np.sqrt(np.mean(residuals**2, axis=1) @ weights / weights.sum()))
    return np.array(out)


def _refined(sights: Sequence[Sight], start: Appearance, prior_sd: Floats) -> Appearance:
    """Gauss-Newton on bends and log blur, damped until the misfit falls."""
    best = _Step(sights, start, prior_sd)
    for _ in range(_ROUNDS):
        change, before = best.solve(), best.cost
        for damping in (1.0, 0.4):
            trial = _Step(sights, _moved(best.at, damping * change), prior_sd, best.scales)
            if trial.cost < best.cost:
                best = trial
                break
        if before - best.cost < _ENOUGH:
            break
    return best.at


class _Step:
    """The objective about one appearance: misfit squared relative to `scales`, and the prior."""

    def __init__(
        self,
        sights: Sequence[Sight],
        at: Appearance,
        prior_sd: Floats,
        scales: Floats | None = None,
    ) -> None:
        self.sights, self.at, self.prior_sd = sights, at, prior_sd
        self.found = [_residuals(sight, at) for sight in sights]
        power = np.array([np.mean(r**2, axis=1) @ w / w.sum() for r, w in self.found])
        self.scales = power if scales is None else scales
        away = _state(at) / prior_sd
        self.cost = float(np.mean(power / self.scales) + _PRIOR_WEIGHT * away @ away)

    def solve(self) -> Floats:
        """The Gauss-Newton step (5,)."""
        moved = [_moved(self.at, _TRIAL * unit) for unit in np.eye(len(_TRIAL))]
        normal = _PRIOR_WEIGHT * np.diag(1 / self.prior_sd**2)
        right = -normal @ _state(self.at)
        for sight, (base, weights), scale in zip(self.sights, self.found, self.scales, strict=True):
            columns = [
                (_residuals(sight, one, weights)[0] - base) / step
                for one, step in zip(moved, _TRIAL, strict=True)
            ]
            share = weights[:, None] / weights.sum() / base.shape[1] / scale / len(self.sights)
            root = np.sqrt(share)
            design = np.stack([(root * column).ravel() for column in columns])
            normal += design @ design.T
            right -= design @ (root * base).ravel()
        return np.asarray(np.linalg.solve(normal, right))


def _state(at: Appearance) -> Floats:
    return np.append(at.bends, np.log([at.blur_px, at.chroma_px / CHROMA_PX]))


def _moved(at: Appearance, change: Floats) -> Appearance:
    bends = at.bends + np.clip(change[:BENDS], -0.1, 0.1)
    blur, chroma = np.array([at.blur_px, at.chroma_px]) * np.exp(np.clip(change[BENDS:], -0.5, 0.5))
    return replace(
        at,
        bends=bends,
        blur_px=float(np.clip(blur, *_BLUR_RANGE_PX)),
        chroma_px=float(np.clip(chroma, *_CHROMA_RANGE_PX)),
    )


def _residuals(
    sight: Sight, appearance: Appearance, weights: Floats | None = None
) -> tuple[Floats, Floats]:
    """Picture minus prediction (k, m) along the clear rays, the outline moved to fit; weights."""
    seen, predicted = compare(prediction_inputs(sight, appearance))
    known, rays = np.empty(0) if weights is None else weights, sight.rays
    return aligned_residuals(seen, predicted, rays.status, rays.around, _COMPARED, _STEP, known)

"""A camera's tone curve and blur, and the surface of balls, by pictures of the balls.

The picture across an outline is predicted and its outline moved to fit best. The residuals then do
not depend on where the outline is, but on tone curve, blur and surface, which are fitted by least
squares: no ground truth is needed. See docs/explanation/outline.md, formula 18.

Glossy balls show highlights of point lights, matt ones do not. Light from a dielectric is its body
colour times one amount plus the lights' colour times another (Shafer 1985, the dichromatic
reflection model). On a coloured ball the two are separable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from measure.arrays import Bools, Bytes, Floats, Ints
from measure.compiling import compiled
from measure_plugins._outline.appearance import BENDS, GLOSSY, MATT, Ambient, Appearance
from measure_plugins._outline.edges import LATER_STEPS, PredictionInputs, compare
from measure_plugins._outline.rays import CLEAR, OCCLUDED, TOGETHER, RaySet, Statuses, clipped
from measure_plugins._outline.reflectance import (
    REWEIGHTINGS,
    lights_about,
    no_point_lights,
    shade_by_lights,
)


@dataclass(frozen=True, eq=False)
class BallPatch:
    """The part of a picture that shows a ball, with the rays across its outline."""

    pixels: Bytes  # (h, w, 3) the part of the picture
    rays: RaySet  # n rays across the outline as found, in px of that part
    half_angle: float  # of the cone, rad
    scale: float  # px per rad
    frame: Floats  # (3, 3) about the axis, see `rays.frame_about`
    behind: Floats  # see `behind.ball_reflection_shares`
    distance: float  # of the ball, mm

    def own_rays(self) -> RaySet:
        """Its rays with a copy of their status, which sampling changes."""
        return self.rays._replace(status=self.rays.status.copy())


def prediction_inputs(patch: BallPatch, appearance: Appearance) -> PredictionInputs:
    """Inputs of a prediction by an appearance along all rays."""
    tables = appearance.tables(patch.half_angle * patch.scale, patch.half_angle)
    point_lights = lights_about(appearance.point_lights, patch.frame, patch.distance)
    lit = shade_by_lights(tables.diffuse, tables.fresnel_loss[0], patch.rays.around, point_lights)
    ambient = Ambient(lit, patch.behind)
    return PredictionInputs(
        patch.pixels, appearance.table, appearance.encoding, patch.own_rays(), tables, ambient
    )


def grouped_inputs(patch: BallPatch, appearance: Appearance) -> PredictionInputs:
    """The same with the ambient light between rays that are predicted together."""
    inputs = prediction_inputs(patch, appearance)
    between = [0.5 * (some[:, ::TOGETHER] + some[:, 1::TOGETHER]) for some in inputs.ambient]
    return inputs._replace(ambient=Ambient(*map(np.ascontiguousarray, between)))


_INNER_RADIUS = 0.93
"""Share of the outline's radius: pixels further out are blurred with the background."""
_MIN_PIXELS = 50
_HIGHLIGHT_QUANTILE = 0.995
"""Surface reflection above this quantile is a highlight: noise alone exceeds it on fewer pixels."""
_LIT_QUANTILE = 0.9  # Quantile of body reflection used as that of the lit side
_MIN_SATURATION = 0.3
"""Least difference of the strongest and the weakest channel of a body colour, of maximum 1."""


def highlights(balls: Sequence[tuple[Bytes, Floats, Bools]], table: Floats) -> float:
    """Highlights of the median ball, as a share of the body reflection of its lit side.

    Args:
        balls: of each, the pixels (h, w, 3) of its part of the picture, its outline (n, 2) in px
            of that part, in order, and whether the way is clear along each of these n rays.
        table: (256,) light of each picture value.

    Returns:
        The share; NaN if all balls are white, too small or mostly occluded.
    """
    shares = [_highlight_share(table[_inside(*ball)]) for ball in balls]
    known = [share for share in shares if not np.isnan(share)]
    return float(np.median(known)) if known else float("nan")


def _inside(pixels: Bytes, outline: Floats, clear: Bools) -> Bytes:
    """Pixels (k, 3) inside the outline, along clear rays."""
    center = outline.mean(axis=0)
    radii, angles = _polar(outline - center)
    order = np.argsort(angles)
    v, u = np.indices(pixels.shape[:2]).reshape(2, -1)
    off, angle = _polar(np.stack([u, v], axis=1) - center)
    ray = order[np.searchsorted(angles[order], angle) % len(order)]
    return np.asarray(pixels.reshape(-1, 3)[(off < _INNER_RADIUS * radii[ray]) & clear[ray]])


def _polar(points: Floats) -> tuple[Floats, Floats]:
    """Radii and angles (n,) of points (n, 2)."""
    return np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])


def _highlight_share(light: Floats) -> float:
    """The same of light (k, 3) from one ball; NaN if it is too small or white."""
    if len(light) < _MIN_PIXELS:
        return float("nan")
    own = np.median(light, axis=0)
    own = own / max(float(own.max()), 1e-9)
    strong, weak = int(np.argmax(own)), int(np.argmin(own))
    if own[strong] - own[weak] < _MIN_SATURATION:
        return float("nan")
    amount = (light[:, strong] - light[:, weak]) / (own[strong] - own[weak])
    grey = light[:, weak] - amount * own[weak]
    brightest, typical = np.quantile(grey, [_HIGHLIGHT_QUANTILE, 0.5])
    return float((brightest - typical) / max(float(np.quantile(amount, _LIT_QUANTILE)), 1e-9))


_COMPARED = int(np.count_nonzero(LATER_STEPS <= 4.0))
"""Number of steps compared: both sides of the edge."""
_COMPARED_STEPS = LATER_STEPS[:_COMPARED]
_STEP = float(LATER_STEPS[1] - LATER_STEPS[0])
_STRAIGHT = np.array([1e-6, 1e-6, 1e-6, 0.15])
_BENT = np.array([0.03, 0.1, 0.05, 0.15])
"""Prior sd of a camera's curve (lift, bow, S) and of its blur (logarithm): straight or bent."""
BENDS_SD = _BENT[:BENDS]
_PRIOR_WEIGHT = 0.02
"""Weight of the prior: relative decrease of the mean square residual that one such sd is worth."""
_TRIAL = np.array([0.004, 0.01, 0.006, 0.1])
"""Steps of the numeric derivatives; that of blur exceeds the steps of its tables."""
_BLUR_RANGE_PX = (0.5, 2.0)
_MIN_COST_DROP = 5e-3
_WORSE_WITH_GRAZING = 0.02
"""Mean logarithm of the residual ratio, with and without grazing reflection, above which it is
left out."""
_MIN_RAYS = 16
_MIN_PATCHES = 4
_GLOSSY_ABOVE = 0.37
"""Strength of highlights above which balls are glossy. On thirty scenes it is at most 0.22 with
matt balls, and at least 0.62 with glossy ones under lamps; satin balls and lights as large as
windows lie between."""
_GLOSSY_BELOW = 0.5
_MATT_ABOVE, _MATT_ABOVE_BENT = 0.88, 0.82
"""Residuals of the glossy model per those of the matt one: below the first, matt paint is not
refined; above, it is chosen for balls without highlights; glossy ones have at most 0.33
and matt ones at least 0.76. Where highlights cannot be measured, on white balls, it is chosen above
the second (the third for bent curves), because the glossy model also has free reflections and
fits matt paint nearly as well."""

Bounds = tuple[float, float]


def as_stated(now: Appearance) -> Appearance:
    """The appearance with all parameters reset that are estimated anew."""
    return replace(now, bends=np.zeros(BENDS), mirrors=True, point_lights=no_point_lights())


def straight_appearance(
    patches: Sequence[BallPatch], start: Appearance, bounds: Bounds
) -> Appearance:
    """Blur and surface that fit the patches best, with the tone curve that `start` names."""
    return _of_either_surface(patches, start, start, _STRAIGHT, bounds)


def bent_appearance(
    patches: Sequence[BallPatch], straight: Appearance, bounds: Bounds
) -> Appearance:
    """Tone curve too; `straight` is the appearance without point lights."""
    bent = refined_bends(patches, straight)
    glossy, matt = (bent, straight) if straight.index == GLOSSY else (straight, bent)
    return _of_either_surface(patches, glossy, matt, _BENT, bounds)


def refined_bends(patches: Sequence[BallPatch], start: Appearance) -> Appearance:
    """Bends and blur that fit the patches better, with the point lights of `start`."""
    return _refined(patches, start, _BENT)


def residual_ratio(one: Appearance, other: Appearance, patches: Sequence[BallPatch]) -> float:
    """Mean square residual of one appearance per that of another: geometric mean over patches."""
    return _residual_share(patches, one, other) ** 2


def unclipped_patches(patches: Sequence[BallPatch]) -> list[BallPatch]:
    """The patches without rays that meet saturated pixels, if enough are left; else all."""
    return useful_patches([_without_clipped(s) for s in patches]) or list(patches)


def surface_bounds(patches: Sequence[BallPatch], table: Floats) -> tuple[Bounds, Bounds]:
    """Bounds between glossy and matt balls by highlights, for straight and for bent curves."""
    seen = highlights([(s.pixels, s.rays.points, s.rays.status == CLEAR) for s in patches], table)
    if np.isnan(seen):
        return (_GLOSSY_BELOW, _MATT_ABOVE), (0.0, _MATT_ABOVE_BENT)
    least = np.inf if seen > _GLOSSY_ABOVE else _GLOSSY_BELOW
    return (least, least), (least, least)


def choose_grazing_reflection(patches: Sequence[BallPatch], appearance: Appearance) -> Appearance:
    """The appearance without grazing reflection if the pictures clearly show none, else with it.

    Rough surfaces need not mirror the colours behind. Patches in front of a grey background have no
    evidence, and a ball in front of another may have more than all the others: the mean counts.
    """
    useful = useful_patches(patches)
    if not useful or appearance.index != GLOSSY:
        return appearance
    without = replace(appearance, mirrors=False)
    ratios = [_plain_misfit(s, appearance) / _plain_misfit(s, without) for s in useful]
    return without if float(np.mean(np.log(ratios))) > _WORSE_WITH_GRAZING else appearance


def _plain_misfit(patch: BallPatch, appearance: Appearance) -> float:
    """RMS residual over all clear rays, not robust: a ball behind few of them counts."""
    return float(np.sqrt(np.mean(_residuals(patch, appearance)[0] ** 2)))


def useful_patches(patches: Sequence[BallPatch]) -> list[BallPatch]:
    """Those with enough clear rays; none if there are too few of them."""
    useful = clear_patches(patches)
    return useful if len(useful) >= _MIN_PATCHES else []


def clear_patches(patches: Sequence[BallPatch]) -> list[BallPatch]:
    """Those with enough clear rays."""
    return [s for s in patches if np.count_nonzero(s.rays.status == CLEAR) >= _MIN_RAYS]


def _without_clipped(patch: BallPatch) -> BallPatch:
    """The patch without rays that meet saturated pixels, which would bias curve and blur."""
    rays = patch.own_rays()
    full = clipped(patch.pixels, rays.points, rays.normals, _COMPARED_STEPS)
    rays.status[full & (rays.status == CLEAR)] = OCCLUDED
    return replace(patch, rays=rays)


def _of_either_surface(
    patches: Sequence[BallPatch],
    glossy: Appearance,
    matt: Appearance,
    prior_sd: Floats,
    bounds: Bounds,
) -> Appearance:
    """Refine an appearance of glossy and one of matt balls, and choose between them.

    By the residuals of the glossy one per those of the matt one: below the first of the bounds the
    latter is not refined, above the second it is chosen.
    """
    glossy, matt = replace(glossy, index=GLOSSY), replace(matt, index=MATT)
    glossy = _refined(patches, glossy, prior_sd)
    if _residual_share(patches, glossy, matt) < bounds[0]:
        return glossy
    matt = _refined(patches, matt, prior_sd)
    return matt if _residual_share(patches, glossy, matt) > bounds[1] else glossy


def _residual_share(patches: Sequence[BallPatch], one: Appearance, other: Appearance) -> float:
    """RMS residual of one appearance per that of another: geometric mean over the patches."""
    return float(np.exp(np.mean(np.log(misfits(patches, one) / misfits(patches, other)))))


def misfits(patches: Sequence[BallPatch], appearance: Appearance) -> Floats:
    """RMS residual (m,) of each patch, in picture values from 0 to 1."""
    out = []
    for patch in patches:
        residuals, weights = _residuals(patch, appearance)
        out.append(np.sqrt(np.mean(residuals**2, axis=1) @ weights / weights.sum()))
    return np.array(out)


def _refined(patches: Sequence[BallPatch], start: Appearance, prior_sd: Floats) -> Appearance:
    """Gauss-Newton on bends and log blur, damped until the cost falls."""
    best = _Update(patches, start, prior_sd)
    for _ in range(REWEIGHTINGS):
        change, before = best.solve(), best.cost
        for damping in (1.0, 0.4):
            trial = _Update(patches, _moved(best.at, damping * change), prior_sd, best.scales)
            if trial.cost < best.cost:
                best = trial
                break
        if before - best.cost < _MIN_COST_DROP:
            break
    return best.at


class _Update:
    """The cost at one appearance: mean square residuals per `scales`, plus the prior."""

    def __init__(
        self,
        patches: Sequence[BallPatch],
        at: Appearance,
        prior_sd: Floats,
        scales: Floats | None = None,
    ) -> None:
        self.patches, self.at, self.prior_sd = patches, at, prior_sd
        self.found = [_residuals(patch, at) for patch in patches]
        power = np.array([np.mean(r**2, axis=1) @ w / w.sum() for r, w in self.found])
        self.scales = power if scales is None else scales
        away = _state(at) / prior_sd
        self.cost = float(np.mean(power / self.scales) + _PRIOR_WEIGHT * away @ away)

    def solve(self) -> Floats:
        """The Gauss-Newton step (4,)."""
        trials = [_moved(self.at, _TRIAL * unit) for unit in np.eye(len(_TRIAL))]
        normal = _PRIOR_WEIGHT * np.diag(1 / self.prior_sd**2)
        right = -normal @ _state(self.at)
        for patch, (base, weights), scale in zip(
            self.patches, self.found, self.scales, strict=True
        ):
            columns = [
                (_residuals(patch, one, weights)[0] - base) / step
                for one, step in zip(trials, _TRIAL, strict=True)
            ]
            share = weights[:, None] / weights.sum() / base.shape[1] / scale / len(self.patches)
            root = np.sqrt(share)
            design = np.stack([(root * column).ravel() for column in columns])
            normal += design @ design.T
            right -= design @ (root * base).ravel()
        return np.asarray(np.linalg.solve(normal, right))


def _state(at: Appearance) -> Floats:
    return np.append(at.bends, np.log(at.blur_px))


def _moved(at: Appearance, change: Floats) -> Appearance:
    bends = at.bends + np.clip(change[:BENDS], -0.1, 0.1)
    blur = at.blur_px * np.exp(np.clip(change[BENDS], -0.5, 0.5))
    return replace(at, bends=bends, blur_px=float(np.clip(blur, *_BLUR_RANGE_PX)))


def _residuals(
    patch: BallPatch, appearance: Appearance, weights: Floats | None = None
) -> tuple[Floats, Floats]:
    """Picture minus prediction (k, m) along clear rays, the outline moved to fit best; weights."""
    seen, predicted = compare(prediction_inputs(patch, appearance))
    known, rays = np.empty(0) if weights is None else weights, patch.rays
    return aligned_residuals(seen, predicted, rays.status, rays.around, _COMPARED, _STEP, known)


_ALIGNMENTS = 3
_TYPICAL = 3.0
"""Mean square of a ray's residuals, per median of all rays, at which its weight falls to a
quarter."""


@compiled
def aligned_residuals(
    seen: Floats,
    predicted: Floats,
    status: Statuses,
    around: Floats,
    compared: int,
    step_px: float,
    weights: Floats,
) -> tuple[Floats, Floats]:
    """Picture minus prediction, after the best shift and growth of the outline.

    Args:
        seen: (3, m, n) picture values along n rays.
        predicted: (3, m, n) the same as predicted.
        status: (n,) see `RaySet`; the k clear rays are compared.
        compared: how many of the m samples count, from the inside.
        weights: (k,) of the rays; if empty, robust ones are computed.

    Returns:
        Residuals (k, 3 compared), and the weights (k,).
    """
    rays = np.flatnonzero(status == CLEAR)
    left, slopes = _off(seen, predicted, rays, compared, step_px)
    sums, where, moved = _sums(left, slopes), around[rays], np.empty(left.shape)
    if len(weights) > 0:
        _move(left, slopes, _shifts(sums, where, weights), moved)
        return moved, weights
    robust, power = np.ones(len(rays)), np.empty(len(rays))
    for _ in range(_ALIGNMENTS):
        _move(left, slopes, _shifts(sums, where, robust), moved)
        for i in range(len(rays)):
            total = 0.0
            for j in range(left.shape[1]):
                total += moved[i, j] * moved[i, j]
            power[i] = total / left.shape[1]
        typical = _TYPICAL * np.median(power) + 1e-9
        robust = 1 / (1 + power / typical) ** 2
    return moved, robust


@compiled
def _off(
    seen: Floats, predicted: Floats, rays: Ints, compared: int, step_px: float
) -> tuple[Floats, Floats]:
    """Seen minus predicted, and its derivative by an outward shift, both ray by ray."""
    m = predicted.shape[1]
    left, slopes = np.empty((len(rays), 3 * compared)), np.empty((len(rays), 3 * compared))
    for k, i in enumerate(rays):
        for c in range(3):
            for j in range(compared):
                low, high = max(j - 1, 0), min(j + 1, m - 1)
                rise = predicted[c, high, i] - predicted[c, low, i]
                left[k, c * compared + j] = seen[c, j, i] - predicted[c, j, i]
                slopes[k, c * compared + j] = -rise / ((high - low) * step_px)
    return left, slopes


@compiled
def _sums(left: Floats, slopes: Floats) -> Floats:
    """Sums (2, k) along each ray of squared slopes, and of slopes times residuals."""
    out = np.zeros((2, len(left)))
    for i in range(len(left)):
        for j in range(left.shape[1]):
            out[0, i] += slopes[i, j] * slopes[i, j]
            out[1, i] += slopes[i, j] * left[i, j]
    return out


@compiled
def _shifts(sums: Floats, around: Floats, weights: Floats) -> Floats:
    """Displacement (k,) of the outline in px along each ray, by its best shift and growth.

    Args:
        sums: (2, k) see `_sums`.
        around: (k, 2) cosine and sine around the axis.
        weights: (k,) of the rays.
    """
    normal, right, design = 1e-9 * np.eye(3), np.zeros(3), np.ones(3)
    for i in range(len(around)):
        design[0], design[1] = around[i, 0], around[i, 1]
        square, toward = weights[i] * sums[0, i], weights[i] * sums[1, i]
        for a in range(3):
            right[a] += design[a] * toward
            for b in range(3):
                normal[a, b] += design[a] * design[b] * square
    x, y, growth = np.linalg.solve(normal, right)
    out = np.empty(len(around))
    for i in range(len(around)):
        out[i] = x * around[i, 0] + y * around[i, 1] + growth
    return out


@compiled
def _move(left: Floats, slopes: Floats, shifts: Floats, out: Floats) -> None:
    """Fill the residuals (k, m) that are left when the outline moves by shifts (k,)."""
    for i in range(len(left)):
        for j in range(left.shape[1]):
            out[i, j] = left[i, j] - slopes[i, j] * shifts[i]

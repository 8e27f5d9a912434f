"""Quadratic shading fitted to what rays show of a ball."""

from __future__ import annotations

import numpy as np

from measure_plugins._outline.appearance.dichromatic import reflected_light
from measure_plugins._outline.appearance.radial_basis import radial_tables
from measure_plugins._outline.appearance.shading import fit_shading, shaded, shading_functions
from measure_plugins._outline.sampling.rays import CLEAR, OCCLUDED, STEPS

LOBES = radial_tables(60.0, 0.045, 1.0, 1.5).diffuse
COEFFICIENTS = np.array([0.1, 0.4, 0.02, 0.1, 0.05, -0.08, 0.04, 0.03, -0.02])
AROUND = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 72, endpoint=False)])
FUNCTIONS = shading_functions(AROUND, LOBES, np.empty((0, 72)))
ALL_CLEAR = np.full(72, CLEAR, np.int8)
SHOWN = shaded(COEFFICIENTS, FUNCTIONS)
FIRST, LAST = (int(k) for k in np.searchsorted(STEPS, (-15.0, 1.0)))


def _misfit(amounts: np.ndarray, status: np.ndarray) -> float:
    """Largest difference, inside, between the fitted and the true shading of all rays."""
    fitted = fit_shading(amounts, status, FUNCTIONS, LAST)
    return float(np.abs(shaded(fitted, FUNCTIONS) - SHOWN)[FIRST:LAST].max())


def test_shading_is_recovered() -> None:
    """What every second ray tells holds for those between."""
    assert _misfit(SHOWN, ALL_CLEAR) < 0.01


def test_shading_shows_its_terms() -> None:
    """A cosine around the axis goes with the fourth function of the radius."""
    one = np.zeros(9)
    one[3] = 2.0
    assert np.allclose(shaded(one, FUNCTIONS), 2 * LOBES[:, 3:4] * AROUND[:, 0])


def test_the_fit_is_that_of_least_squares_where_nothing_is_off() -> None:
    """On any number of rays."""
    rng = np.random.default_rng(2)
    for rays in (24, 25, 66):
        angles = np.sort(rng.uniform(0, 2 * np.pi, rays))
        around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        functions = shading_functions(around, LOBES, np.empty((0, rays)))
        seen = shaded(COEFFICIENTS, functions) + rng.uniform(-1e-6, 1e-6, (len(LOBES), rays))
        terms = functions[:, :LAST:2].reshape(9, -1)
        normal = terms @ terms.T + 1e-3 * np.eye(9)
        wanted = np.linalg.solve(normal, terms @ seen[:LAST:2].ravel())
        status = np.full(rays, CLEAR, np.int8)
        fitted = fit_shading(seen, status, functions, LAST)
        assert np.allclose(fitted, wanted, rtol=0, atol=2e-3)
        assert np.abs(shaded(fitted - wanted, functions)[:LAST]).max() < 1e-4


def test_a_highlight_is_ignored() -> None:
    """Bright spots on a tenth of the pixels leave the shading alone."""
    seen = SHOWN.copy()
    seen[FIRST : FIRST + 8, 10:24] += 0.8
    assert _misfit(seen, ALL_CLEAR) < 0.02


def test_hidden_rays_tell_nothing() -> None:
    """What stands before a third of the rays is taken for shading only if nobody says so."""
    seen, status = SHOWN.copy(), ALL_CLEAR.copy()
    seen[:, 20:44] = 0.0
    assert _misfit(seen, status) > 0.03
    status[20:44] = OCCLUDED
    assert _misfit(seen, status) < 0.02


def test_reflected_light_is_found_behind_rays_that_are_not_clear():
    tables = radial_tables(60.0, 0.045, 1.0, 1.5)
    true = np.linspace(0.8, 0.2, tables.grey.shape[1])
    grey, status = np.repeat((tables.grey @ true)[:, None], 72, axis=1), ALL_CLEAR.copy()
    grey[:, 10:30], status[10:30] = 5.0, OCCLUDED
    found = (
        reflected_light(grey, status, tables.reflection_solver)
        + tables.reflection_prior[:, None] * true[0]
    )
    for ray in (0, 9, 30, 71):
        off = np.abs(tables.grey @ found[:, ray] - tables.grey @ true)[FIRST:LAST]
        assert off.max() < 0.02 * (tables.grey @ true).max()


def test_paint_that_reflects_nothing_shows_no_reflected_light():
    assert not reflected_light(np.ones((35, 72)), ALL_CLEAR, np.zeros((8, 46))).any()

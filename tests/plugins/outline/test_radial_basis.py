"""What a lit ball shows along a ray."""

from __future__ import annotations

import numpy as np
import pytest

from measure_plugins._outline.appearance.radial_basis import (
    DEFLECTIONS,
    _hats,
    fresnel,
    one_of,
    radial_tables,
    stacked_tables,
)

SIZES = [(35.0, 0.05), (12.25, 0.02)]


def test_directions_are_shared_by_their_neighbours_as_interpolation_does():
    turned = np.append(np.linspace(0, np.pi, 500), DEFLECTIONS)
    shares = _hats(turned)
    assert np.allclose(shares.sum(axis=0), 1)
    any_values = np.array([3.0, -1, 4, 1, -5, 9, 2, -6])
    assert np.allclose(any_values @ shares, np.interp(turned, DEFLECTIONS, any_values))


@pytest.mark.parametrize(("cosine", "share"), [(1.0, 0.04), (0.0, 1.0)])
def test_clear_plastic_reflects_what_fresnel_says(cosine, share):
    assert fresnel(np.array([cosine]), 1.5) == pytest.approx(share)


def test_paint_without_a_boundary_reflects_nothing():
    assert np.all(fresnel(np.linspace(0, 1, 11), 1.0) == 0)


def test_inside_and_outside_share_a_ray_and_the_ball_is_none_of_what_is_outside():
    tables = radial_tables(*SIZES[0], blur_px=0.5, index=1.5)
    assert tables.outside[0] == pytest.approx(0, abs=1e-9)
    assert tables.outside[-1] == pytest.approx(1, abs=1e-9)
    # What a matt ball sends out alike from everywhere is what the surroundings leave.
    matt = radial_tables(*SIZES[0], blur_px=0.5, index=1.0)
    assert np.allclose(matt.diffuse[:, 0], 1 - matt.outside)


def test_stacked_tables_are_those_of_each_ball():
    tables = stacked_tables(SIZES, 0.9, 1.5)
    for i, size in enumerate(SIZES):
        for own, table in zip(one_of(tables, i), radial_tables(*size, 0.9, 1.5), strict=True):
            assert np.array_equal(own, table)

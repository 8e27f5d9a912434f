from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import correlate1d, gaussian_filter1d
from scipy.special import erf

from measure_plugins._outline.appearance.sensor import (
    CHROMA_PX,
    CHROMA_REACH,
    encode,
    encoding,
    read_off,
)
from measure_plugins._outline.sampling.rays import STEPS, RaySet, sample

YCC = np.array([[0.114, 0.587, 0.299], [1 - 0.114, -0.587, -0.299], [-0.114, -0.587, 1 - 0.299]])
"""Brightness, and blue and red minus it, of BGR."""


def test_colour_is_blurred_more_than_brightness_along_rays():
    values = np.random.default_rng(0).random((3, 30, 7))
    parts = np.einsum("ac,cmn->amn", YCC, values)
    sigma = np.sqrt(CHROMA_PX**2 + 1 / 6)  # px, and steps
    for k in (1, 2):
        parts[k] = gaussian_filter1d(parts[k], sigma, axis=0, mode="nearest", radius=CHROMA_REACH)
    kernel = [1 / 12, 10 / 12, 1 / 12]  # of variance 1/6 px^2
    parts[0] = correlate1d(parts[0], kernel, axis=0, mode="nearest")
    wanted = np.einsum("ca,amn->cmn", np.linalg.inv(YCC), parts)[:, CHROMA_REACH:]
    assert read_off(values) == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize("tilt_deg", [7, 33, 61])
def test_brightness_is_blurred_as_much_as_sampling_blurs_a_grey_edge(tilt_deg):
    """Across an edge, at all phases, `sample` shows profiles wider than the edge itself."""
    normal = np.array([np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))])
    v, u = np.mgrid[:80, :80]
    beyond = (u - 40) * normal[0] + (v - 40) * normal[1]
    picture = np.repeat(np.rint(255 * _edge(beyond))[..., None], 3, axis=2).astype(np.uint8)
    along = np.linspace(-20, 20, 400)[:, None] * np.array([-normal[1], normal[0]])
    points, normals = 40 + along, np.tile(normal, (400, 1))
    rays = RaySet(points, normals, normals, np.zeros(400, np.int8), np.empty((0, 400, 2)))
    everywhere = np.ones(len(STEPS), np.bool_)
    _, seen = sample(picture, np.linspace(0, 1, 256), rays, STEPS, everywhere, 0)
    alone = np.repeat(_edge(STEPS)[None, :, None], 3, axis=0)
    left = seen[0, CHROMA_REACH:].mean(axis=1) - read_off(alone)[0, :, 0]
    without = seen[0, CHROMA_REACH:].mean(axis=1) - alone[0, CHROMA_REACH:, 0]
    assert np.abs(left).max() < 0.22 * np.abs(without).max()
    assert np.abs(without).max() > 0.015


def _edge(px):
    """A blurred edge, 0.2 to 0.8."""
    return 0.5 - 0.3 * erf(px / 0.76 / np.sqrt(2))


def test_light_is_encoded_by_the_curve_that_the_table_inverts():
    table = np.linspace(0, 1, 256) ** 2.2
    levels = np.random.default_rng(1).uniform(0.02, 1, (3, 4, 5))
    assert encode(levels**2.2, encoding(table)) == pytest.approx(levels, abs=1e-3)
    beyond = encode(np.array([[[-0.5, 0.0, 1.0, 1.5]]]), encoding(table))
    assert beyond.ravel() == pytest.approx([0, 0, 1, 1])

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from measure_plugins._edges.sensor import CHROMA_REACH, blur_chroma, encode, encoding

YCC = np.array([[0.114, 0.587, 0.299], [1 - 0.114, -0.587, -0.299], [-0.114, -0.587, 1 - 0.299]])
"""Brightness, and blue and red minus it, of BGR."""


def test_colour_is_blurred_along_rays_and_brightness_is_not():
    values = np.random.default_rng(0).random((3, 30, 7))
    parts = np.einsum("ac,cmn->amn", YCC, values)
    for k in (1, 2):  # sigma of 0.8 px at steps of half a pixel, cut off at three sigma
        parts[k] = gaussian_filter1d(parts[k], 1.6, axis=0, mode="nearest", radius=CHROMA_REACH)
    wanted = np.einsum("ca,amn->cmn", np.linalg.inv(YCC), parts)[:, CHROMA_REACH:]
    assert blur_chroma(values) == pytest.approx(wanted, abs=1e-12)


def test_light_is_encoded_by_the_curve_that_the_table_inverts():
    table = np.linspace(0, 1, 256) ** 2.2
    levels = np.random.default_rng(1).uniform(0.02, 1, (3, 4, 5))
    assert encode(levels**2.2, encoding(table)) == pytest.approx(levels, abs=1e-3)
    beyond = encode(np.array([[[-0.5, 0.0, 1.0, 1.5]]]), encoding(table))
    assert beyond.ravel() == pytest.approx([0, 0, 1, 1])

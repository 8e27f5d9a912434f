"""What hypothesis draws: vectors, rotations (near none and near half a turn too), cameras."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from measure.geometry import RigidTransform
from measure.model import Camera, Intrinsics


def _finite(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_nan=False, allow_subnormal=False)


def vectors(limit: float = 500.0) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*[_finite(limit)] * 3).map(np.array)


@st.composite
def directions(draw: st.DrawFn) -> np.ndarray:
    vector = draw(vectors(1.0).filter(lambda v: np.linalg.norm(v) > 1e-3))
    return vector / np.linalg.norm(vector)


ANGLES = st.one_of(
    st.floats(0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, np.pi - 1e-4, np.pi - 1e-8, np.pi]),
)
"""Turns in rad: anything, and on purpose almost none and almost half a turn."""


@st.composite
def rotvecs(draw: st.DrawFn) -> np.ndarray:
    return draw(directions()) * draw(ANGLES)


@st.composite
def transforms(draw: st.DrawFn) -> RigidTransform:
    return RigidTransform.from_rotvec(draw(rotvecs()), draw(vectors()))


@st.composite
def small_steps(draw: st.DrawFn) -> np.ndarray:
    """A delta (6,) of the perturb chart, up to 1 mm and 10 mrad per axis."""
    return np.concatenate([draw(vectors(1.0)), draw(vectors(0.01))])


@st.composite
def covariances(draw: st.DrawFn, size: int = 6) -> np.ndarray:
    """A random covariance with standard deviations of 0.01 to 1."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    mix = rng.normal(size=(size, size))
    basis, _ = np.linalg.qr(mix)
    return (basis * rng.uniform(0.01, 1.0, size) ** 2) @ basis.T


@st.composite
def lenses(draw: st.DrawFn) -> Intrinsics:
    """Lenses from none to strongly distorting, of all of OpenCV's lengths of coefficients."""
    mild = [_finite(0.3), _finite(0.2), _finite(5e-3), _finite(5e-3)]
    more = [_finite(0.05)]
    rational = [_finite(0.2), _finite(0.05), _finite(0.01)]
    count = draw(st.sampled_from([0, 4, 5, 8]))
    coefficients = [draw(x) for x in (mild + more + rational)[:count]]
    fx, fy = draw(st.floats(500, 2500)), draw(st.floats(500, 2500))
    cx, cy = draw(st.floats(560, 720)), draw(st.floats(300, 420))
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Intrinsics((1280, 720), matrix, np.array(coefficients))


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    return Camera("camera", draw(lenses()), draw(transforms()))


def numeric_jacobian(function, point: np.ndarray, step: float) -> np.ndarray:
    """Central differences of `function` (any shape) at `point` (k,): (..., k)."""
    steps = np.eye(len(point)) * step
    columns = [(function(point + h) - function(point - h)) / (2 * step) for h in steps]
    return np.stack(columns, axis=-1)

"""Two rotations, of a base and on a flange, that bring the turns of hand and poses together."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from measure.arrays import Floats

_STEPS = 12
_TOLERANCE_RAD = 0.02  # up to which solutions are as good
_STARTS = 24  # rotations that are tried where the closed form leaves one open
_ALIKE = 0.98  # ratio of two singular values, from which there are several solutions


def align_turns(hand: Floats, pose: Floats) -> tuple[Floats, Floats, float]:
    """Rotations world_from_base and body_from_flange, of base_from_flange and world_from_body.

    Those are (n, 3, 3); last the angle, rad RMS, by which they miss each other.
    """
    return min(turn_starts(hand, pose), key=lambda found: found[2])


def turn_starts(hand: Floats, pose: Floats) -> list[tuple[Floats, Floats, float]]:
    """What `align_turns` returns: once, or several that are as good, if the turns leave one open.

    So they do if all are about one axis, or if there are none.
    """
    K = turn_products(hand, pose)
    u, sizes, v = np.linalg.svd(K)
    pairs = [(nearest_rotation(u[:, 0]), nearest_rotation(v[0]))]
    if sizes[1] > _ALIKE * sizes[0]:
        turns = Rotation.random(_STARTS, rng=0).as_matrix()
        pairs += [(turn, np.eye(3)) for turn in turns]
    out = []
    for base, flange in pairs:
        for _ in range(_STEPS if len(pairs) > 1 else 0):
            flange = nearest_rotation(K.T @ base.T.ravel())
            base = nearest_rotation(K @ flange.T.ravel())
        agreed = float(base.T.ravel() @ K @ flange.T.ravel())
        out.append((base, flange, float(np.sqrt(max(0.0, 3 - agreed)))))
    best = min(found[2] for found in out)
    return [found for found in out if found[2] < best + _TOLERANCE_RAD]


def leave_one_open(hand: Floats, pose: Floats) -> bool:
    """Whether the turns are about one axis, or none, so that many rotations do as well."""
    sizes = np.linalg.svd(turn_products(hand, pose), compute_uv=False)
    return bool(sizes[1] > _ALIKE * sizes[0])


def turn_products(hand: Floats, pose: Floats) -> Floats:
    """With vec by columns, vec(R_base) = (R_hand x R_pose) vec(R_flange): their mean (9, 9)."""
    return np.asarray(np.einsum("nab,ncd->acbd", hand, pose).reshape(9, 9) / len(hand))


def nearest_rotation(columns: Floats) -> Floats:
    """Of a matrix (9,) by columns, of any size and sign."""
    matrix = columns.reshape(3, 3).T
    u, _, v = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(u @ v)

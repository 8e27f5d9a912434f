"""Small errors of a chain's links, and how they move the tool.

Link k is followed by a small motion in its joint's frame: six numbers, x y z in mm and a rotation
vector in rad. Along the joint's axis these are the classical offsets d and theta; they describe
tables of Denavit and Hartenberg, URDF and any other description alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.geometry import RigidTransform, skew
from measure.robots.chain import SerialChain

PARAMETERS = ("x_mm", "y_mm", "z_mm", "x_deg", "y_deg", "z_deg")
"""What a link can be off by, in its joint's frame."""
TURNS = np.array([False] * 3 + [True] * 3)
"""Which of these are angles."""


def link_names(chain: SerialChain) -> tuple[str, ...]:
    """Names of all link errors (6 joints), from `link1_x_mm` on."""
    return tuple(f"link{k + 1}_{name}" for k in range(chain.size) for name in PARAMETERS)


def with_link_errors(chain: SerialChain, errors: ArrayLike) -> SerialChain:
    """The chain whose links are off by `errors` (6 joints), in mm and rad."""
    moves = floats("errors", errors, 6 * chain.size).reshape(-1, 6)
    off = RigidTransform.from_rotvec(moves[:, 3:], moves[:, :3]).matrix
    joints = [replace(j, link=j.link @ m) for j, m in zip(chain.joints, off, strict=True)]
    return replace(chain, joints=tuple(joints))


def link_jacobian(chain: SerialChain, q: ArrayLike) -> Floats:
    """Derivative of `chain.pose(q)` by the link errors: (n, 6, 6 joints), q is (n, joints).

    Rows are those of `RigidTransform.perturb`, as in `SerialChain.jacobian`.
    """
    frames = chain.frames(q)
    tip = frames[:, -1, :3, 3]
    out = np.zeros((len(frames), 6, 6 * chain.size))
    before = np.broadcast_to(np.eye(4), (len(frames), 4, 4))
    for k, joint in enumerate(chain.joints):
        frame = before @ joint.link
        turn, lever = frame[:, :3, :3], tip - frame[:, :3, 3]
        at = 6 * k
        out[:, :3, at : at + 3] = out[:, 3:, at + 3 : at + 6] = turn
        out[:, :3, at + 3 : at + 6] = -skew(lever) @ turn
        before = frames[:, k]
    return out

"""Serial kinematic chains: forward and inverse kinematics and Jacobians, in batches.

Link k is followed by a small error in its joint's frame: six numbers, x y z in mm and a rotation
vector in rad. Along the joint's axis these are the classical offsets d and theta; they describe
tables of Denavit and Hartenberg, URDF and any other description alike. No motion shows all of them.
They are held as random effects: normal, with a standard deviation for lengths and one for angles,
which are estimated too (Harville 1977, JASA 72, 320).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew
from measure.geometry.normal_equations import posterior_covariance

_DAMPING = 1e-9  # mm^2 or rad^2, of the normal matrix


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint and the rigid link before it."""

    # (4, 4) homogeneous transform from the previous joint's frame to this one's, in mm.
    link: Floats
    axis: Floats  # (3,) unit vector in this joint's own frame
    prismatic: bool = False  # True if the joint slides (mm) instead of turning (rad)

    def parts(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Matrices A, B, C, D with `link @ motion(q) == A + B cos q + C sin q + D q`."""
        constant, cosine, sine, linear = (np.zeros((4, 4)) for _ in range(4))
        constant[3, 3] = 1.0
        if self.prismatic:
            constant[:3, :3] = np.eye(3)
            linear[:3, 3] = self.axis
        else:
            along = np.outer(self.axis, self.axis)
            constant[:3, :3], cosine[:3, :3] = along, np.eye(3) - along
            sine[:3, :3] = skew(self.axis)
        return self.link @ constant, self.link @ cosine, self.link @ sine, self.link @ linear


@dataclass(frozen=True, eq=False)
class SerialChain:
    """Joints from the base to the tool."""

    # in order; `q` below holds rad for turning joints and mm for sliding ones.
    joints: tuple[Joint, ...]
    tool: Floats  # (4, 4) transform from the last joint's frame to the tool tip

    @property
    def size(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @cached_property
    def parts(self) -> tuple[Floats, Floats, Floats, Floats]:
        """`Joint.parts` of all joints, each (joints, 4, 4); the tool is folded into the last."""
        stacked = np.array([joint.parts() for joint in self.joints])
        stacked[-1] = stacked[-1] @ self.tool
        constant, cosine, sine, linear = np.moveaxis(stacked, 1, 0)
        return constant, cosine, sine, linear

    def frames(self, q: ArrayLike) -> Floats:
        """Transforms (..., joints, 4, 4) from the base after each joint, the last with the tool."""
        angles = floats("q", q, "...", self.size)[..., None, None]
        constant, cosine, sine, linear = self.parts
        steps = constant + cosine * np.cos(angles) + sine * np.sin(angles) + linear * angles
        out = [steps[..., 0, :, :]]
        for index in range(1, self.size):
            out.append(out[-1] @ steps[..., index, :, :])
        return np.stack(out, axis=-3)

    def pose(self, q: ArrayLike) -> RigidTransform:
        """`base_from_tool` at joint positions (..., joints)."""
        last = self.frames(q)[..., -1, :, :]
        return RigidTransform(last[..., :3, :3], last[..., :3, 3])

    def tip_mm(self, q: ArrayLike) -> Floats:
        """Tool tip (..., 3) in the base frame, mm."""
        return self.frames(q)[..., -1, :3, 3]

    def jacobian(self, q: ArrayLike) -> Floats:
        """Derivative of tip position and of rotation (both in the base) by `q`: (..., 6, joints).

        Rows 0-2 are mm per rad or mm; rows 3-5 rad per rad: the chart of `RigidTransform.perturb`.
        """
        frames = self.frames(q)
        tip = frames[..., -1, :3, 3]
        out = np.zeros((*tip.shape[:-1], 6, self.size))
        for index, joint in enumerate(self.joints):
            frame = frames[..., index, :, :]
            if index == self.size - 1:
                frame = frame @ np.linalg.inv(self.tool)
            axis = frame[..., :3, :3] @ joint.axis
            if joint.prismatic:
                out[..., :3, index] = axis
            else:
                out[..., :3, index] = np.cross(axis, tip - frame[..., :3, 3])
                out[..., 3:, index] = axis
        return out

    def solve_tip(
        self,
        tip_mm: ArrayLike,
        start: ArrayLike,
        free: Sequence[int],
        *,
        tolerance_mm: float = 1e-6,
    ) -> Floats:
        """Joint positions that put the tip (..., 3) at `tip_mm`, moving only three `free` joints.

        From a start (..., joints), whose value the others keep. DegenerateGeometryError: some point
        is out of reach; the message says how many and how far the nearest approach of the worst
        stays.
        """
        target = floats("tip_mm", tip_mm, "...", 3)
        q = np.array(np.broadcast_to(start, (*target.shape[:-1], self.size)), dtype=np.float64)
        miss = np.inf * np.ones(target.shape[:-1])
        for _ in range(50):
            gap = target - self.tip_mm(q)
            miss = np.linalg.norm(gap, axis=-1)
            if np.all(miss < tolerance_mm):
                return q
            step = _damped(self.jacobian(q)[..., :3, list(free)], gap)
            q[..., list(free)] += step * np.minimum(1.0, 40.0 / (miss + 1e-12))[..., None]
        lost = int(np.sum(~(miss < tolerance_mm)))
        raise DegenerateGeometryError(
            f"{lost} of {miss.size} tip positions cannot be reached with joints {list(free)}; "
            f"the worst stays {np.nanmax(miss):.3g} mm away: move them into the workspace"
        )


def _damped(slope: Floats, gap: Floats) -> Floats:
    """Levenberg's step: least squares that shrinks where the Jacobian is singular."""
    turned = np.swapaxes(slope, -1, -2)
    normal = turned @ slope + _DAMPING * np.eye(slope.shape[-1])
    return np.asarray(np.linalg.solve(normal, turned @ gap[..., None])[..., 0], dtype=np.float64)


def dh_link(alpha_rad: float, a_mm: float, theta_rad: float = 0.0, d_mm: float = 0.0) -> Floats:
    """Craig's link transform Rx(alpha) Tx(a) Rz(theta) Tz(d), as (4, 4)."""
    turn_x = RigidTransform.from_rotvec([alpha_rad, 0.0, 0.0])
    turn_z = RigidTransform.from_rotvec([0.0, 0.0, theta_rad])
    shift_x = RigidTransform(np.eye(3), np.array([a_mm, 0.0, 0.0]))
    shift_z = RigidTransform(np.eye(3), np.array([0.0, 0.0, d_mm]))
    return (turn_x @ shift_x @ turn_z @ shift_z).matrix


PARAMETERS = ("x_mm", "y_mm", "z_mm", "x_deg", "y_deg", "z_deg")
"""What a link can be off by, in its joint's frame."""
TURNS = np.array([False] * 3 + [True] * 3)
"""Which of these are angles."""
_USUAL_SD = np.array([0.3, 5e-4])  # mm and rad: the least that is counted with
_LARGEST_SD = np.array([5.0, 0.05])  # mm and rad: the most that is counted with, whatever is left
_LEAST_NOISE = 1e-2
"""Variance of what is left over what is stated, at least: few residuals may be met exactly."""
_STEPS = 50
_SAME_SD = 1e-3  # relative change of the links' standard deviations, below which they are found


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


def usual_sd(count: int) -> Floats:
    """Standard deviations of `count` link errors before anything is known of them."""
    return np.resize(_USUAL_SD[TURNS.astype(int)], count)


@dataclass(frozen=True, eq=False)
class LinkEffects:
    """A step towards the most likely parameters, the last of which are link errors."""

    step: Floats  # (m,)
    covariance: Floats  # (m, m)
    link_sd: Floats  # (links,) of the link errors before they are fitted
    noise: float  # variance of what is left, over what is stated

    def solved(
        self,
        normal: tuple[Floats, Floats, float, int],
        known: Floats,
        links: Floats,
        share: float = 1.0,
    ) -> LinkEffects:
        """Solve normal equations, by expectation and maximisation from these deviations on.

        Args:
            normal: matrix (m, m) and right side (m,) of whitened slopes and residuals, the
                residuals' sum of squares, and how many they are.
            known: (m - links,) inverse variances of the other parameters; 0 where all is open.
            links: (links,) errors at which the residuals were taken.
            share: of the residuals that are independent.
        """
        N, g, squares, count = normal
        size, sd, noise = len(links), self.link_sd, self.noise
        for _ in range(_STEPS):
            precision = np.concatenate([known, sd**-2.0])
            C = posterior_covariance(N * (share / noise), precision)
            pull = g * (share / noise)
            pull[len(pull) - size :] -= precision[len(pull) - size :] * links
            x = C @ pull
            before = sd
            sd = _pooled((links + x[len(x) - size :]) ** 2, np.diag(C)[len(x) - size :])
            left = float(squares - 2 * x @ g + x @ N @ x + share * np.sum(C * N)) / count
            noise = max(left, _LEAST_NOISE)
            if np.abs(sd / before - 1).max(initial=0.0) < _SAME_SD:
                break
        return LinkEffects(x, np.asarray(C, dtype=np.float64), sd, noise)


def _pooled(squares: Floats, variances: Floats) -> Floats:
    """Standard deviations (links,): one of all lengths, one of all angles.

    Of squared errors and of their variances, which are those of the prior where nothing shows an
    error: what is not shown leaves the deviation as it is.
    """
    turns = np.resize(TURNS, squares.shape)
    out, second = np.empty_like(squares), squares + np.maximum(variances, 0.0)
    for which, usual, most in zip((~turns, turns), _USUAL_SD, _LARGEST_SD, strict=True):
        if which.any():
            out[which] = np.clip(np.sqrt(second[which].mean()), usual, most)
    return out

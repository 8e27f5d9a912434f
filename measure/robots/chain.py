"""Serial kinematic chains: forward and inverse kinematics and Jacobians, in batches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.errors import DegenerateGeometryError
from measure.geometry import RigidTransform, skew

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

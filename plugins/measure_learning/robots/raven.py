"""RAVEN-II: kinematics, transmission and the meaning of its `raven_state` message.

Sources: H. King et al., "Kinematic analysis of the RAVEN-II surgical robotics research platform"
(2012), and the robot's public control software (motor.h, defines.h, fwd_cable_coupling.cpp).
Joint order here: shoulder, elbow (rad), insertion (mm), tool roll, wrist, grasper yaw (rad).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from measure.arrays import Floats, floats
from measure.robots.chain import Joint, SerialChain, dh_link
from measure.robots.schema import Feature, Reading, StateSchema

Arm = Literal["left", "right"]
DRIVES = 7  # shoulder, elbow, insertion, roll, wrist, jaw 1, jaw 2
PLACES = (0, 1, 2, 4, 5, 6, 7)  # places of the seven drives in the 8-vectors of the message
ARM_TYPE = {"left": 24, "right": 10}  # board serials in defines.h: gold, green

_ALPHA_DEG = {"left": (0, 75, 128, 0, 90, 90), "right": (180, 75, 52, 0, 90, 90)}
_OFFSET_DEG = {"left": (205, 180, 90, 0, -90, 0), "right": (25, 0, -90, 0, -90, 0)}
_TOOL_SHAFT_MM = -470.0
_WRIST_TO_TIP_MM = 13.0

# Motor turns per joint motion, rad/rad (rad/m for the insertion), from capstan and pulley radii.
_TOOL_RATIO = (10.905 / 5.005) * (26.0 / 7.0)
RATIO = np.append(
    [136.196, 121.522, 2158.59], _TOOL_RATIO * np.array([120 / 180, 200 / 180, 100 / 90, 100 / 90])
)
# The elbow's cable runs over the shoulder and the insertion's over both.
ELBOW_PER_SHOULDER = 0.14545
INSERTION_M_PER_SHOULDER = 0.0077974
INSERTION_M_PER_ELBOW = 0.0080774
ENCODER_COUNTS_PER_RAD = 4000.0 / (2.0 * np.pi)


def coupling() -> Floats:
    """(7, 7): how far each cable is pulled per unit of each drive's joint motion (rad, m)."""
    out = np.eye(DRIVES)
    out[1, 0] = ELBOW_PER_SHOULDER
    out[2, 0], out[2, 1] = INSERTION_M_PER_SHOULDER, INSERTION_M_PER_ELBOW
    return out


def motors_from_drives(drives: ArrayLike) -> Floats:
    """Motor angles (..., 7) rad from drive positions (..., 7) in rad and m."""
    return floats("drives", drives, "...", DRIVES) @ coupling().T * RATIO


def drives_from_motors(motors: ArrayLike) -> Floats:
    """Drive positions (..., 7) in rad and m from motor angles (..., 7) rad."""
    return (floats("motors", motors, "...", DRIVES) / RATIO) @ np.linalg.inv(coupling()).T


def joints_from_drives(drives: ArrayLike) -> Floats:
    """Chain joints (..., 6) in rad and mm; the grasper's yaw is half the jaws' difference."""
    d = floats("drives", drives, "...", DRIVES)
    yaw = 0.5 * (d[..., 5] - d[..., 6])
    return np.stack([d[..., 0], d[..., 1], 1e3 * d[..., 2], d[..., 3], d[..., 4], yaw], axis=-1)


def raven_chain(arm: Arm = "left") -> SerialChain:
    """The arm's chain in Craig's convention; the tip is the jaws' pivot."""
    alpha, offset = np.deg2rad(_ALPHA_DEG[arm]), np.deg2rad(_OFFSET_DEG[arm])
    a = (0.0, 0.0, 0.0, 0.0, 0.0, _WRIST_TO_TIP_MM)
    d = (0.0, 0.0, 0.0, _TOOL_SHAFT_MM, 0.0, 0.0)
    joints = tuple(
        Joint(dh_link(alpha[i], a[i], offset[i], d[i]), np.array([0.0, 0.0, 1.0]), i == 2)
        for i in range(6)
    )
    return SerialChain(joints, np.eye(4))


@dataclass(frozen=True)
class Field:
    """A field of `raven_state`: how many numbers each arm has in it, and their unit."""

    name: str
    per_arm: int
    unit: str
    integer: bool = False

    def names(self) -> tuple[str, ...]:
        """Names of one arm's numbers."""
        if self.per_arm == 1:
            return (self.name,)
        if self.name in ("pos", "pos_d"):
            return tuple(f"{self.name}_{axis}" for axis in "xyz")
        if self.name in ("ori", "ori_d"):
            return tuple(f"{self.name}_{row}{column}" for row in range(3) for column in range(3))
        return tuple(f"{self.name}_{index}" for index in range(self.per_arm))


# In the message's order; the shared numbers (run level, sub-level, last_seq, dt) stand apart.
FIELDS = (
    Field("type", 1, "", True),
    Field("pos", 3, "um", True),
    Field("ori", 9, ""),
    Field("ori_d", 9, ""),
    Field("pos_d", 3, "um", True),
    Field("encVals", 8, "counts", True),
    Field("dac_val", 8, "counts", True),
    Field("tau", 8, "N m"),
    Field("mpos", 8, "deg"),
    Field("jpos", 8, "deg"),
    Field("mvel", 8, "deg/s"),
    Field("jvel", 8, "deg/s"),
    Field("mpos_d", 8, "deg"),
    Field("jpos_d", 8, "deg"),
    Field("grasp_d", 1, "rad"),
    Field("encoffsets", 8, "counts"),
    Field("jac_vel", 6, "mm/s"),
    Field("jac_f", 6, "mm/s"),
)


def raven_schema(arm: Arm = "left") -> StateSchema:
    """One arm's 118 numbers of `raven_state`, named field by field."""
    degree = np.pi / 180.0
    return StateSchema(
        robot=f"raven2-{arm}",
        features=tuple(Feature(name, field.unit) for field in FIELDS for name in field.names()),
        position=(Reading.of("pos_x", 1e-3), Reading.of("pos_y", 1e-3), Reading.of("pos_z", 1e-3)),
        joints=(
            Reading.of("jpos_0", degree),
            Reading.of("jpos_1", degree),
            Reading.of("jpos_2", 1e3 * degree),  # the message holds metres x 180/pi
            Reading.of("jpos_4", degree),
            Reading.of("jpos_5", degree),
            Reading((("jpos_6", 0.5 * degree), ("jpos_7", -0.5 * degree))),
        ),
        torques=(
            *(Reading.of(f"tau_{place}") for place in (0, 1, 2, 4, 5)),
            Reading((("tau_6", 0.5), ("tau_7", -0.5))),
        ),
        coupled=(3, 4, 5),
        chain=raven_chain(arm),
        groups={field.name: field.names() for field in FIELDS},
    )

"""The patient-side manipulator of the da Vinci Research Kit, as logged by joint commands."""

from __future__ import annotations

import numpy as np

from measure.robots.chain import Joint, SerialChain
from measure.robots.schema import Feature, Reading, StateSchema

# Public kinematics of the dVRK (its user guide, PSM with a large needle driver), in mm.
REMOTE_CENTRE_TO_TOOL_MM = 431.8
TOOL_LENGTH_MM = 416.2
PITCH_TO_YAW_MM = 9.1
YAW_TO_TIP_MM = 10.2


def psm_chain() -> SerialChain:
    """Yaw, pitch (rad), insertion (mm), roll, wrist pitch, wrist yaw (rad)."""

    def joint(axis: tuple[int, int, int], before_mm: float = 0.0, *, slide: bool = False) -> Joint:
        link = np.eye(4)
        link[2, 3] = -before_mm
        return Joint(link, np.array(axis, dtype=np.float64), slide)

    tool = np.eye(4)
    tool[2, 3] = -YAW_TO_TIP_MM
    return SerialChain(
        (
            joint((0, -1, 0)),
            joint((-1, 0, 0)),
            joint((0, 0, -1), TOOL_LENGTH_MM - REMOTE_CENTRE_TO_TOOL_MM, slide=True),
            joint((0, 0, -1)),
            joint((-1, 0, 0)),
            joint((0, -1, 0), PITCH_TO_YAW_MM),
        ),
        tool,
    )


def psm_schema() -> StateSchema:
    """Commanded joints q1..q6 (rad, m) and the tip they stand for (mm)."""
    units = ("rad", "rad", "m", "rad", "rad", "rad")
    joints = tuple(f"q{number}_cmd" for number in range(1, 7))
    position = tuple(f"p{axis}_cmd" for axis in "xyz")
    return StateSchema(
        robot="dvrk-psm",
        features=(
            *(Feature(name, unit) for name, unit in zip(joints, units, strict=True)),
            *(Feature(name, "mm") for name in position),
        ),
        position=(Reading.of("px_cmd"), Reading.of("py_cmd"), Reading.of("pz_cmd")),
        joints=tuple(
            Reading.of(name, 1000.0 if unit == "m" else 1.0)
            for name, unit in zip(joints, units, strict=True)
        ),
        coupled=(3, 4, 5),
        chain=psm_chain(),
        groups={"joints": joints, "position": position},
    )

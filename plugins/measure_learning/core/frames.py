"""`frame.toml`: where a robot's base and its tool's body are, as `measure register` found them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import FiniteFloat

from measure.arrays import Floats
from measure.errors import EstimatorError
from measure.geometry import RigidTransform, propagate, skew
from measure.reading import FileModel
from measure.robots import StateSchema
from measure.session import StatedTransform, dump_toml, load_toml
from measure_learning.core.assemble import PoseTrack


@dataclass(frozen=True, eq=False)
class RobotFrame:
    """A registered robot."""

    robot: str
    world_from_base: RigidTransform
    flange_from_body: RigidTransform
    clock_offsets_s: Mapping[str, float]  # robot minus camera time, of recordings; none of stops
    covariance: Floats  # (m, m) in the `perturb` charts of both, s, and mm and rad of links
    covariance_order: tuple[str, ...]  # what its rows are
    judgement: Mapping[str, Any]
    kinematics: Mapping[str, Any] | None = None  # the links' errors, if they were fitted
    # cameras on the flange: the world is the body's frame then, and the body that of the cameras.
    eye_in_hand: bool = False

    def values(self) -> dict[str, Any]:
        """As files hold it; of several recordings `clock_offset_s` is a table by their names."""
        clocks = dict(self.clock_offsets_s)
        poses = {
            name: {"quat_wxyz": pose.quat_wxyz, "translation_mm": pose.translation}
            for name, pose in vars(self).items()
            if isinstance(pose, RigidTransform)
        }
        return {
            "robot": self.robot,
            **({"eye_in_hand": True} if self.eye_in_hand else {}),
            "clock_offset_s": clocks if len(clocks) != 1 else next(iter(clocks.values())),
            "covariance_order": self.covariance_order,
            "covariance": self.covariance,
            **poses,
            "judgement": self.judgement,
            "kinematics": self.kinematics,
        }

    def static_transforms(self) -> list[str]:
        """Commands of ROS 2 that publish both transforms."""
        names = ("world", "body") if not self.eye_in_hand else ("body", "cameras")
        out = []
        for parent, child, pose in (
            (names[0], "base", self.world_from_base),
            ("flange", names[1], self.flange_from_body),
        ):
            w, *xyz = pose.quat_wxyz.tolist()
            values = dict(zip("xyz", (pose.translation / 1e3).tolist(), strict=True))
            values |= dict(zip(("qx", "qy", "qz", "qw"), (*xyz, w), strict=True))
            words = " ".join(f"--{name} {value:.9f}" for name, value in values.items())
            out.append(
                f"ros2 run tf2_ros static_transform_publisher {words} --frame-id {parent} "
                f"--child-frame-id {child}"
            )
        return out

    def to_base(self, track: PoseTrack) -> PoseTrack:
        """Point and flange's rotation in the robot's base, of a track in the cameras' world.

        EstimatorError: the track has no rotations, and the point is not the body's origin.
        """
        if self.eye_in_hand and track.rotations is not None:
            track = track.inverted()
        base_from_world = self.world_from_base.inverse()
        point, turns = self.flange_from_body.inverse().translation, track.rotations
        moved, covariances = track.positions_mm, track.covariances
        P = track.pose_covariances
        if turns is not None and P is not None:
            lever = turns @ point
            moved = moved + lever
            by = np.tile(np.eye(6), (len(turns), 1, 1))
            by[:, :3, 3:] = -skew(lever)
            P = propagate(np.kron(np.eye(2), base_from_world.rotation) @ by, P)
            P = 0.5 * (P + np.swapaxes(P, 1, 2))  # as files hold it
            turns = base_from_world.rotation @ turns @ self.flange_from_body.rotation.T
            covariances = P[:, :3, :3]
        elif np.linalg.norm(point) > 1e-6:
            raise EstimatorError(
                f"{track.name}: holds positions alone, and the frame needs poses: give a run, or "
                "a table with qw, qx, qy, qz"
            )
        else:
            covariances = propagate(base_from_world.rotation, covariances)
        return replace(
            track,
            positions_mm=base_from_world.apply(moved),
            covariances=covariances,
            rotations=turns,
            pose_covariances=P,
        )

    def tip_covariances(self, schema: StateSchema, states: Floats) -> tuple[Floats, Floats]:
        """What base and tool leave open of tip and rotation (n, 3, 3), mm^2 and rad^2 in the base.

        It is common to all labels that were measured by this frame: none of them shows it.
        """
        base, tool = self.world_from_base, self.flange_from_body.translation
        lever = schema.position_mm(states) @ base.rotation.T
        turns = np.broadcast_to(np.eye(3), (len(states), 3, 3))
        if schema.chain is not None:
            turns = schema.chain.pose(schema.joint_positions(states)).rotation
        back = np.broadcast_to(base.rotation.T, turns.shape)
        slopes = np.concatenate([-back, back @ skew(lever), -turns, -turns @ skew(tool)], axis=2)
        nothing, C = np.zeros_like(turns), self.covariance[:12, :12]
        turned = np.concatenate([nothing, -back, nothing, -turns], axis=2)
        return propagate(slopes, C), propagate(turned, C)


class _RegisteredFile(FileModel):
    robot: str
    clock_offset_s: FiniteFloat | dict[str, FiniteFloat]
    covariance_order: list[str]
    covariance: list[list[FiniteFloat]]
    world_from_base: StatedTransform
    flange_from_body: StatedTransform
    judgement: dict[str, Any]
    kinematics: dict[str, Any] | None = None
    eye_in_hand: bool = False


def write_frame(path: Path, frame: RobotFrame) -> None:
    """Write a `frame.toml`."""
    path.write_text(dump_toml(frame.values()), encoding="utf-8")


def read_frame(path: Path) -> RobotFrame:
    """Read a `frame.toml`; EstimatorError if it is missing or does not fit, with the line."""
    file = load_toml(path, _RegisteredFile, EstimatorError)
    clocks = file.clock_offset_s
    return RobotFrame(
        file.robot,
        file.world_from_base.transform(),
        file.flange_from_body.transform(),
        clocks if isinstance(clocks, dict) else {"": clocks},
        np.array(file.covariance),
        tuple(file.covariance_order),
        file.judgement,
        file.kinematics,
        file.eye_in_hand,
    )

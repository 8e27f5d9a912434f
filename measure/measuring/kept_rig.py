"""The cameras at an instant of a run: where each stands by then, and which are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, TypeAlias

from measure.arrays import Floats
from measure.geometry import RigidTransform
from measure.measuring.measurement import Measurement
from measure.model import Camera, Detection, Expectation, FrameSet, Motion

Keep: TypeAlias = Literal["off", "warn", "follow"]
"""What is done about cameras that are moved meanwhile."""
HOLDING = 2
"""Cameras that must agree without the one in question: two alone cannot tell which was moved."""


@dataclass(frozen=True, eq=False)
class CameraChange:
    """A camera is left out from a frame set on, or used again where it stands now."""

    camera: str
    frame_set: int  # the first one that is measured so
    # when it was moved; or of the first picture that its new pose rests on
    since_s: float
    world_from_camera: RigidTransform | None = None  # the new pose; None: it is left out
    covariance: Floats | None = None  # (6, 6) of that in its `perturb` chart


@dataclass(frozen=True, eq=False)
class KeptRig:
    """All cameras as they are used at an instant."""

    cameras: tuple[Camera, ...]  # those left out as they stood before
    changes: tuple[CameraChange, ...] = ()  # in order, those that hold by now
    follows: bool = True  # whether a camera that was moved is left out, and brought back

    @property
    def away(self) -> tuple[str, ...]:
        """The cameras that are left out: they were moved, and where they stand is not known."""
        last = {change.camera: change for change in self.changes if self.follows}
        return tuple(name for name, change in last.items() if change.world_from_camera is None)

    def changed(self, change: CameraChange) -> KeptRig:
        """The same after one more change."""
        cameras, pose = self.cameras, change.world_from_camera
        if pose is not None:
            cameras = tuple(
                replace(
                    camera,
                    world_from_camera=pose,
                    pose_covariance=change.covariance,
                    pose_intrinsics_covariance=None,
                )
                if camera.name == change.camera
                else camera
                for camera in cameras
            )
        return replace(self, cameras=cameras, changes=(*self.changes, change))


class Keeper(Protocol):
    """Keeps the rig of a pipeline; asked in this order of each frame set."""

    def rig(self, frame_set: int) -> KeptRig:
        """The rig to measure a frame set with; the same object as long as nothing changes."""

    def looks(
        self, frame_set: FrameSet, measured: Measurement, motion: Motion | None
    ) -> Mapping[str, Sequence[Expectation]]:
        """More cameras to look at, and where the balls are expected; all over if nowhere."""

    def note(self, measured: Measurement, found: Mapping[str, Sequence[Detection]]) -> Measurement:
        """Take what was found there; gives the measurement with the views of cameras left out."""

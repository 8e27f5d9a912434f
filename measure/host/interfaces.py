"""The interfaces of detectors, triangulators and pose solvers.

A plugin is a class with a `name`, a `Config` and one method. Plugins of this project and of others
are treated alike; `measure.testing` checks that a class keeps its contract.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from measure.host.settings import Settings
from measure.model import BallPosition, Body, Camera, Detection, Expectation, Image, Motion, Pose

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
"""Pattern of plugin names: lower case, words joined by "-"."""


class Plugin(ABC):
    """Base of all kinds of plugins."""

    name: ClassVar[str]  # how a user selects it; lower case, words joined by "-"
    Config: ClassVar[type[Settings]] = Settings  # its settings, a frozen pydantic model

    def warm_up(self) -> None:  # noqa: B027 - most plugins have nothing to do here
        """Compile or load what is slow, before the first frame is timed or waited for."""

    def warm_up_parts(self) -> Sequence[Callable[[], object]]:
        """`warm_up` in parts that may run in either order: two processes share what takes long."""
        return (self.warm_up,)


class Detector(Plugin):
    """Finds the balls of a body in one camera's images.

    What it finds in an image depends on that image alone, unless the class says `stateful`.
    """

    # whether results depend on the images seen before. Images then come in order of time. A
    # detector that keeps no state may be shown images again.
    stateful: ClassVar[bool] = False
    # whether its detections hold outlines (`Detection.outline_px`); None if that depends on the
    # images, and is found out from the first ones.
    provides_outlines: ClassVar[bool | None] = None

    def __init__(self, config: Settings, body: Body, camera: Camera) -> None:
        self.config = config
        self.body = body
        self.camera = camera

    @abstractmethod
    def detect(self, image: Image, expected: Sequence[Expectation]) -> list[Detection]:
        """Find balls.

        Args:
            image: BGR uint8 pixels of size `camera.intrinsics.size_wh`, with time and name.
            expected: at most one per ball; a ball without one is searched for in the whole frame.

        Returns:
            Detections. A ball that is not seen is simply absent. For an expected ball there is at
            most one; for a searched ball there may be several candidates, the best score first, and
            geometry decides.
        """


class SelfCalibratingDetector(Detector):
    """Optional interface: a detector that estimates its camera's image formation from the images.

    It uses an image for that only if it is later than all before. Images known to it may therefore
    come again, in any order, and then give the same detections; it is not `stateful`.
    """

    @property
    @abstractmethod
    def needs_burn_in(self) -> bool:
        """Whether it needs more images before those of a recording are measured.

        While any camera's detector says so, the first frame sets of a recording are measured for
        this alone, up to a limit; then the recording is measured from its start. Images of cameras
        that deliver now are not repeated.
        """

    @property
    @abstractmethod
    def calibration_state(self) -> object:
        """Its estimates, for the detectors of the other cameras; None if there are none yet."""

    @abstractmethod
    def fuse_calibration(self, states: Sequence[object]) -> None:
        """Combine the estimates of all cameras; called once, at the end of the burn-in.

        Args:
            states: `calibration_state` of the detectors of all cameras, its own among them.
        """

    @abstractmethod
    def enter_realtime(self) -> None:
        """Do work that takes longer than an image in the background from now on.

        Called where cameras are measured live, after the burn-in. Results may then
        depend on the speed of the machine.
        """


class Triangulator(Plugin):
    """Turns detections of one ball in several cameras into its centre in the world."""

    def __init__(self, config: Settings) -> None:
        self.config = config

    @abstractmethod
    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> BallPosition | None:
        """Locate one ball.

        Args:
            detections: of one ball, at most one per camera, all effective.
            cameras: by name.

        Returns:
            The position, or None if the detections do not determine one (fewer than two cameras,
            parallel rays).
        """

    def triangulate_all(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> list[BallPosition]:
        """Locate every ball, ball by ball unless overridden: one call may cost less than many.

        Args:
            detections: of any balls, at most one per ball and camera, all effective.
            cameras: by name.

        Returns:
            The results of `triangulate` for all balls of two detections or more, in order of first
            appearance.
        """
        by_ball: dict[str, list[Detection]] = {}
        for detection in detections:
            by_ball.setdefault(detection.ball, []).append(detection)
        several = [seen for seen in by_ball.values() if len(seen) > 1]
        positions = [self.triangulate(seen, cameras) for seen in several]
        return [position for position in positions if position is not None]


class PoseSolver(Plugin):
    """Turns detections and positions of the balls into the body's pose.

    Attributes:
        requires_outlines: whether it needs detections that hold outlines.
        config: its settings.
        body: what is located.
    """

    requires_outlines: ClassVar[bool] = False

    def __init__(self, config: Settings, body: Body) -> None:
        self.config = config
        self.body = body

    @abstractmethod
    def solve(
        self,
        positions: Sequence[BallPosition],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body.

        Args:
            positions: at most one per ball.
            detections: every effective detection; a solver may fit these and skip the positions.
            cameras: by name.
            time_s: the instant of the pose; each detection has its own `time_s`.
            prior: where the body is expected and how it moves, if known.

        Returns:
            The pose, or None if there is too little to determine one.
        """

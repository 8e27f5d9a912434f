"""What a detector, a triangulator and a pose solver are.

A plugin is a class with a `name`, a `Config` and one method. Built-ins and strangers are treated
alike; a class need not live in this project, only keep this contract (`measure.testing` checks it).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from measure.host.settings import Settings
from measure.model import Body, Camera, Detection, Expectation, Fix, Image, Motion, Pose

NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
"""What a plugin may be called: lower case, words joined by "-"."""


class Plugin(ABC):
    """What all kinds share.

    Attributes:
        name: how a user selects it; lower case, words joined by "-".
        Config: its settings, a frozen pydantic model.
    """

    name: ClassVar[str]
    Config: ClassVar[type[Settings]] = Settings

    def warm_up(self) -> None:  # noqa: B027 - most plugins have nothing to do here
        """Compile or load what is slow, before the first frame is timed or waited for."""


class Detector(Plugin):
    """Finds the balls of a body in one camera's images. Keeps no state between calls.

    Attributes:
        out_of_order: whether it may be shown earlier pictures again. One that keeps no state may;
            one that does must know them by their times. Unless it is set, time runs on.
        measures_outlines: whether its detections hold outlines (`Detection.outline_px`); None if it
            does not say: its first pictures tell.
    """

    out_of_order: ClassVar[bool] = False
    measures_outlines: ClassVar[bool | None] = None

    def __init__(self, config: Settings, body: Body, camera: Camera) -> None:
        self.config = config
        self.body = body
        self.camera = camera

    def warm_up(self) -> None:
        """As every plugin does; part by part, if it is made of parts."""
        for part in self.warm_up_parts():
            part()

    def warm_up_parts(self) -> Sequence[Callable[[], object]]:
        """What is slow in parts that may be done in any order.

        What they compile into a cache on disk, a second process compiles from the other end.
        """
        return ()

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

    @property
    def wants_rehearsal(self) -> bool:
        """Whether it would rather see more pictures before those of a recording are measured.

        While it says so, the first frame sets of a recording are measured for nothing else, as far
        as that leads anywhere; then the recording is measured from its start. Pictures that come
        from cameras at work come once. Only for detectors that may see pictures `out_of_order`.
        """
        return False

    @property
    def learnt(self) -> object:
        """What the other cameras' detectors are to hear of its rehearsal."""
        return None

    def confer(self, learnt: Sequence[object]) -> None:
        """A rehearsal is over: cameras are often of one kind, and learn more together.

        Args:
            learnt: by the detectors of all cameras, each as its property says.
        """

    def go_live(self) -> None:
        """Somebody waits for every pose from now on: do what takes long aside, or not at all.

        Called where cameras are measured while they deliver, after the rehearsal. Results may then
        depend on how fast the machine is.
        """


class Triangulator(Plugin):
    """Turns detections of one ball in several cameras into its centre in the world."""

    def __init__(self, config: Settings) -> None:
        self.config = config

    @abstractmethod
    def triangulate(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> Fix | None:
        """Locate one ball.

        Args:
            detections: of one ball, at most one per camera, all effective.
            cameras: by name.

        Returns:
            The fix, or None if the detections do not determine one (fewer than two cameras,
            parallel rays).
        """

    def triangulate_all(
        self, detections: Sequence[Detection], cameras: Mapping[str, Camera]
    ) -> list[Fix]:
        """Locate every ball, ball by ball unless overridden: one call may cost less than many.

        Args:
            detections: of any balls, at most one per ball and camera, all effective.
            cameras: by name.

        Returns:
            What `triangulate` gives for each ball of two detections or more, in the order in which
            the balls first come.
        """
        by_ball: dict[str, list[Detection]] = {}
        for detection in detections:
            by_ball.setdefault(detection.ball, []).append(detection)
        several = [seen for seen in by_ball.values() if len(seen) > 1]
        fixes = [self.triangulate(seen, cameras) for seen in several]
        return [fix for fix in fixes if fix is not None]


class PoseSolver(Plugin):
    """Turns what was seen of all balls into the body's pose.

    Attributes:
        fits_outlines: whether it finds none without detections that hold outlines.
    """

    fits_outlines: ClassVar[bool] = False

    def __init__(self, config: Settings, body: Body) -> None:
        self.config = config
        self.body = body

    @abstractmethod
    def solve(
        self,
        fixes: Sequence[Fix],
        detections: Sequence[Detection],
        cameras: Mapping[str, Camera],
        time_s: float,
        prior: Motion | None = None,
    ) -> Pose | None:
        """Locate the body.

        Args:
            fixes: at most one per ball.
            detections: every effective detection; a solver may fit these and skip the fixes.
            cameras: by name.
            time_s: the instant the pose shall hold for; each detection has its own `time_s`.
            prior: where the body is expected and how it moves, if known.

        Returns:
            The pose, or None if there is too little to determine one.
        """

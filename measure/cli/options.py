"""Groups of options that several commands share, declared once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

from cyclopts import Parameter

from measure import api
from measure.host import Registry
from measure.measuring import Profile

InjectedRegistry: TypeAlias = Annotated[Registry, Parameter(parse=False)]
"""Type of a command's keyword `registry`: all plugins but those left out with `--disable`."""
SettingTexts: TypeAlias = Annotated[tuple[str, ...], Parameter(name="--set")]
"""Type of a command's option `--set`, NAME=VALUE each."""
FIELDS = Parameter(name="*")
"""Of a record in a command's signature: its fields are options, explained by its docstring."""


@Parameter(name="*")
@dataclass(frozen=True)
class ProfileOptions:
    """The profile, and what is changed of it.

    Attributes:
        profile: `precise`, `paper`, or the path of a profile of your own (.toml).
        detector: a detector plugin to use instead of the profile's.
        triangulator: name of a triangulator.
        solver: name of a pose solver.
        set_: a setting as STAGE.NAME=VALUE, such as detector.rays=128; may be repeated.
    """

    profile: str = "precise"
    detector: str | None = None
    triangulator: str | None = None
    solver: str | None = None
    set_: SettingTexts = ()

    def chosen(self) -> Profile:
        """The profile with the changes."""
        return api.choose(
            api.load_profile(self.profile),
            {"detector": self.detector, "triangulator": self.triangulator, "solver": self.solver},
            self.set_,
        )


@Parameter(name="*")
@dataclass(frozen=True)
class BodyOptions:
    """What is measured.

    Attributes:
        body: the body's file, instead of a session's own; may be repeated for several bodies.
        reference: name of the body that the others are measured relative to.
    """

    body: tuple[Path, ...] = ()
    reference: str | None = None


@Parameter(name="*")
@dataclass(frozen=True)
class ShowOptions:
    """The viewer.

    Attributes:
        spawn: open the viewer at once and watch.
        connect: send to a viewer that runs already, as rerun+http://127.0.0.1:9876/proxy.
    """

    spawn: bool = False
    connect: str | None = None

    def address(self) -> str | None:
        """Address of the viewer, which is opened if `spawn` asks for it."""
        from measure.viewing.viewer import open_viewer

        return open_viewer([]).listens if self.spawn else self.connect


@Parameter(name="*")
@dataclass(frozen=True)
class ViewerOptions(ShowOptions):
    """The viewer, and its recording.

    Attributes:
        images: pictures to keep in the viewer's recording: none, all, or those of every N-th set.
        recording: write run.rrd for the viewer.
    """

    images: str = "10"
    recording: Annotated[bool, Parameter(negative="--no-recording")] = True


@Parameter(name="*")
@dataclass(frozen=True)
class RobotOptions:
    """The robot and its log.

    Attributes:
        robot_log: the robot's log: Parquet, text or a bag; one for all runs, or one each.
        robot: a known one (raven, raven-right, dvrk-psm, ur5e, ur10e, franka, xarm6, kuka-iiwa), a
            robot.toml, a .urdf or the calibration.yaml of a UR.
        topic: of the robot's states in a bag.
    """

    robot_log: Annotated[tuple[Path, ...], Parameter(name="--robot-log")] = ()
    robot: str = "raven"
    topic: str | None = None

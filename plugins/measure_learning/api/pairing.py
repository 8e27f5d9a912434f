"""Data sets to learn from: poses and robot logs paired, or simulated; and robots registered."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from measure.api.outputs import new_folder
from measure.errors import ConfigError, EstimatorError
from measure.host import Dataset, Report
from measure.processes import Progress, quiet
from measure.robots import StateSchema
from measure_learning.api.training import check_seeds
from measure_learning.robots import LogFile, find_schema
from measure_learning.robots.logs import NewStates, steps_mm
from measure_learning.simulator import Cables

if TYPE_CHECKING:
    from measure_learning.core import AssemblySettings, PoseTrack, TrajectoryFacts
    from measure_learning.core.frames import RobotFrame
    from measure_learning.core.registration import RegisterOptions
    from measure_learning.core.sightings import Stops
    from measure_learning.robots import StateLog

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RobotLogs:
    """The robot and its log.

    Attributes:
        robot_log: the robot's log: Parquet, text or a bag; one for all runs, or one each; none for
            tables that hold labels or stops.
        robot: a known one (raven, raven-right, dvrk-psm, ur5e, ur10e, franka, xarm6, kuka-iiwa), a
            robot.toml, a .urdf or the calibration.yaml of a UR.
        topic: of the robot's states in a bag.
    """

    robot_log: tuple[Path, ...] = ()
    robot: str = "raven"
    topic: str | None = None


@dataclass(frozen=True)
class RunFacts:
    """What is known of runs that are paired with a robot's log.

    Attributes:
        frame: where the robot is, written by `measure register`; its base is the cameras' world
            and its tip the body's origin if omitted.
        restart_name: of the robot's restart or the day, one for all runs or one each; training
            keeps runs of one name together.
    """

    frame: Path | None = None
    restart_name: tuple[str, ...] = ()


def make_dataset(
    runs: Sequence[Path],
    source: RobotLogs,
    out: Path,
    settings: AssemblySettings,
    known: RunFacts | None = None,
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Pair runs with robot logs, or take tables that already hold labels, and write a data set.

    Args:
        runs: run folders, files of poses, or (without logs) tables of states and errors.
        out: the Parquet file; its data card goes beside it.
    """
    from measure_learning.core import assemble, files

    _check_name(out)
    logs, schema = source.robot_log, find_schema(source.robot)
    known = known or RunFacts()
    facts: list[TrajectoryFacts] = []
    if logs:
        tracks = read_tracks(runs, known.frame, schema.robot)
        tracks = _of_restarts(tracks, known.restart_name)
        each = open_logs(runs, logs, schema, source.topic)
        data, facts = assemble(list(zip(tracks, each, strict=True)), settings)
    elif known.restart_name:
        raise ConfigError("--restart-name is of runs: tables of labels have a column `restart`")
    else:
        data = _labelled(runs, schema, settings.as_it_is)
    files.write_dataset(out, data, facts, ", ".join(map(str, [*runs, *logs])))
    return data, facts


def read_tracks(runs: Sequence[Path], frame: Path | None, robot: str) -> list[PoseTrack]:
    """Tracks of the reported point in the robot's base; of the body's origin without a frame."""
    from measure_learning.core import files
    from measure_learning.core.frames import read_frame

    tracks = [files.read_poses(path) for path in runs]
    if frame is None:
        return tracks
    known = read_frame(frame)
    if known.robot != robot:
        raise EstimatorError(f"{frame}: is the frame of robot '{known.robot}', not of '{robot}'")
    return [known.to_base(track) for track in tracks]


def _of_restarts(tracks: Sequence[PoseTrack], restarts: Sequence[str]) -> list[PoseTrack]:
    """The tracks with their restarts' names before their own."""
    if len(restarts) not in (0, 1, len(tracks)) or any("/" in n or not n for n in restarts):
        raise ConfigError(
            f"--restart-name {' '.join(restarts)}: expected one name without '/' for all "
            f"{len(tracks)} runs, or one each"
        )
    each = restarts if len(restarts) == len(tracks) else [*restarts] * len(tracks)
    if not each:
        return list(tracks)
    return [replace(t, name=f"{name}/{t.name}") for t, name in zip(tracks, each, strict=True)]


def _check_name(out: Path) -> None:
    if out.suffix != ".parquet":
        raise EstimatorError(f"{out}: a data set's file name must end with .parquet")


def open_logs(
    runs: Sequence[object], logs: Sequence[Path], schema: StateSchema, topic: str | None
) -> list[LogFile]:
    """A log for each run; EstimatorError unless there is one for all, or one each."""
    from measure_learning.robots import LogFile

    if len(logs) not in (1, len(runs)):
        raise EstimatorError(
            f"{len(runs)} runs and {len(logs)} robot logs: give one log for all, or one each"
        )
    read = [LogFile(path, schema, topic) for path in logs]
    for path, log in zip(logs, read, strict=True):
        if lacks := [name for name in schema.groups if name not in log.schema.groups]:
            _log.warning(
                "%s: lacks %s: the other %d of %d features are taken; a model trained with all of "
                "them cannot use it", path, ", ".join(lacks), len(log.schema.features),
                len(schema.features),
            )  # fmt: skip
        if log.computed:
            _log.warning("%s: the tip is computed from the joints, by %s", path, schema.robot)
        if said := str(log.new):
            _log.warning("%s: %s", path, said)
    return read * len(runs) if len(read) == 1 else read


def _labelled(tables: Sequence[Path], schema: StateSchema, as_it_is: bool) -> Dataset:
    import numpy as np

    from measure_learning.core import files, join
    from measure_learning.core.causes import check_labels, label_doubts

    bare = [path for path in tables if path.is_dir() or not files.has_labels(path)]
    if bare:
        raise EstimatorError(
            f"{bare[0]}: has no labels (run, ex, ey, ez) of its own: give the robot's log "
            "with --robot-log"
        )
    data = join([files.read_labelled(path, schema) for path in tables])
    for name, rows in data.runs():
        used = np.flatnonzero(data.usable[rows]) + rows.start
        doubts = label_doubts(schema, data.states[used], data.errors_mm[used])
        check_labels(name, doubts, as_it_is=as_it_is)
    return data


@dataclass(frozen=True)
class SimulationOptions:
    """A data set of the simulated robot.

    Attributes:
        simulate_min: instead of runs, so many minutes of the simulated RAVEN-II.
        pairs: simulated: pairs of state and pose; the paper's rate (353 a minute) if absent.
        restarts: simulated: sessions, each after a restart.
        seed: simulated: of motion, restarts and noise.
        wear: simulated: slack and friction relative to new cables.
        exact: simulated: labels of the true tip at the true time, to judge by.
        rotations: simulated: labels hold the tip's rotation, too.
    """

    simulate_min: float | None = None
    pairs: int | None = None
    restarts: int = 4
    seed: int = 1
    wear: float = 1.0
    exact: bool = False
    rotations: bool = False


def simulate_dataset(
    out: Path, options: SimulationOptions, report: Report
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Write a data set of the simulated RAVEN-II to `out`.

    Its labels are measured with noise on a clock that must be found, or exact. ConfigError: a
    length, a count, a seed or a wear that makes no data; EstimatorError: no data set's name.
    """
    from measure_learning.core import (
        PAPER_MINUTES,
        PAPER_PAIRS,
        LabelKind,
        files,
        simulated_dataset,
    )

    _check_name(out)
    o, minutes = options, options.simulate_min or 0.0
    check_seeds(seed=o.seed)
    rate = PAPER_PAIRS / PAPER_MINUTES
    count = (o.pairs or round(rate * minutes)) if 0 < minutes < math.inf else 0
    if not (count > 0 and o.restarts > 0):
        raise ConfigError(
            f"--simulate-min {minutes:g} --pairs {count} --restarts {o.restarts}: expected "
            "positive numbers"
        )
    data, facts = simulated_dataset(
        minutes=minutes, pairs=count, restarts=o.restarts, seed=o.seed,
        labels=LabelKind(o.exact, o.rotations), cables=Cables(wear=o.wear), report=report,
    )  # fmt: skip
    source = f"simulated RAVEN-II, {minutes:g} min, {o.restarts} restarts, seed {o.seed}, "
    source += f"wear {o.wear:g}{', true positions' if o.exact else ''}"
    files.write_dataset(out, data, facts, source)
    return data, facts


@dataclass(frozen=True)
class RenderOptions:
    """A recording of the simulated robot.

    Attributes:
        seconds: length of the recording.
        frame_hz: frame sets per second.
        seed: of motion, restart and pictures.
        clock_offset_s: how far the robot's clock is ahead of the cameras'.
        wear: slack and friction relative to new cables.
    """

    seconds: float = 60.0
    frame_hz: float = 15.0
    seed: int = 1
    clock_offset_s: float = 1.5
    wear: float = 1.0


def simulate_recording(
    out: Path,
    options: RenderOptions = RenderOptions(),
    overwrite: bool = False,
    progress: Progress = quiet,
) -> None:
    """Render a recording of the simulated RAVEN-II, with its log and its truth.

    Args:
        out: the session's folder. The robot's log is `robot.parquet` in it.
    """
    from measure_learning.core.rendering import render_recording

    with new_folder(out, overwrite, "session.toml"):
        seconds, frame_hz, offset_s = options.seconds, options.frame_hz, options.clock_offset_s
        if not (0 < seconds < math.inf and 0 < frame_hz < math.inf and seconds * frame_hz >= 1):
            raise ConfigError(
                f"--seconds {seconds:g} --frame-hz {frame_hz:g}: expected two positive numbers "
                "that make at least one frame set"
            )
        if not math.isfinite(offset_s):
            raise ConfigError(f"--clock-offset-s {offset_s:g}: expected a number")
        check_seeds(seed=options.seed)
        render_recording(out, progress=progress, **asdict(options))


def register(
    runs: Sequence[Path], source: RobotLogs, options: RegisterOptions, stops: Sequence[Path] = ()
) -> RobotFrame:
    """Where a robot's base, the body on its tool and its clock are, from runs and logs, or stops.

    Args:
        runs: run folders, or tables of poses; the cameras and the body stayed where they were.
        stops: instead of runs and logs, tables with pose and joints of a stop in each row.
    """
    from measure.results import read_run
    from measure.results.pose_table import shared_errors
    from measure_learning.core import files
    from measure_learning.core.registration import LoggedTrack, register, register_stops
    from measure_learning.robots import find_schema

    logs, schema = source.robot_log, find_schema(source.robot)
    if stops:
        if runs or logs:
            raise ConfigError("--stops holds poses and joints: leave out runs and --robot-log")
        pairs, schemas = zip(*(_stops(path, schema, options) for path in stops), strict=True)
        return register_stops(pairs, schemas[0], options)
    if not (runs and logs):
        raise ConfigError("give runs of the moving robot, and its log with --robot-log; or --stops")
    tracks = [files.read_poses(run) for run in runs]
    if len({track.name for track in tracks}) < len(tracks):
        raise EstimatorError("two recordings have the same name: rename one")
    shared = [shared_errors(read_run(run)) if run.is_dir() else None for run in runs]
    opened = _logs_or_tool_poses(tracks, logs, schema, source.topic, options)
    return register(list(map(LoggedTrack, tracks, opened, shared)), options)


OTHER_FILES = {
    ".urdf": "the robot with its measured links and zeros",
    ".yaml": "those of a UR, for its ROS driver",
    ".calib": "where the cameras are, for easy_handeye2",
    ".launch.py": "base and tool as static transforms, as MoveIt writes them",
}
"""Files of other programs by the end of their names."""


def other_file(out: Path, frame: RobotFrame, robot: str) -> str:
    """What a file of another program holds of a registration, by its name: `OTHER_FILES`.

    ConfigError: another name, or the links were not fitted and the file is of them.
    """
    import shlex

    import numpy as np

    from measure_learning.robots import other_programs
    from measure_learning.robots.links import TURNS, with_link_errors
    from measure_learning.robots.urdf import joint_names, urdf_text

    check_other_file(out, links=frame.kinematics is not None)
    if out.name.endswith(".launch.py"):
        words = [shlex.split(command)[4:] for command in frame.static_transforms()]
        return other_programs.launch_text(words)
    if out.suffix == ".calib":
        camera = frame.flange_from_body if frame.eye_in_hand else frame.world_from_base.inverse()
        return other_programs.easy_handeye_text(out.stem, camera, eye_in_hand=frame.eye_in_hand)
    schema = find_schema(robot)
    assert frame.kinematics is not None
    assert schema.chain is not None
    values = np.array(frame.kinematics["values"])
    errors = np.where(np.resize(TURNS, values.shape), np.deg2rad(values), values)
    measured = with_link_errors(schema.chain, errors)
    if out.suffix == ".urdf":
        return urdf_text(schema.robot, joint_names(schema), measured)
    return other_programs.ur_calibration_text(measured)


def check_other_file(out: Path, *, links: bool) -> None:
    """Refuse (ConfigError) a name that `other_file` does not know, or links that are not fitted."""
    kind = next((end for end in OTHER_FILES if out.name.endswith(end)), None)
    if kind is None:
        known = "; ".join(f"{end} ({what})" for end, what in OTHER_FILES.items())
        raise ConfigError(f"{out}: its name must end with {known}")
    if kind in (".urdf", ".yaml") and not links:
        raise ConfigError(f"{out}: holds the measured links: give --kinematics")


def _stops(path: Path, schema: StateSchema, options: RegisterOptions) -> tuple[Stops, StateSchema]:
    """The stops of a table, and the schema of their states."""
    from measure_learning.core.files import read_stops
    from measure_learning.core.registration import choose_reading, stops_apart_deg
    from measure_learning.core.sightings import pairs_in_table

    track, states = read_stops(path, schema, options.angles, eye_in_hand=options.eye_in_hand)
    track = track.inverted() if options.eye_in_hand else track
    if not isinstance(states, list):
        return pairs_in_table(track, states), schema
    pairs = [pairs_in_table(track, reading.states) for reading in states]
    apart = [stops_apart_deg(p, r.schema) for p, r in zip(pairs, states, strict=True)]
    best, words = choose_reading(path.name, states, apart)
    _log.warning("%s", words)
    return pairs[best], states[best].schema


def _logs_or_tool_poses(
    tracks: Sequence[PoseTrack],
    logs: Sequence[Path],
    schema: StateSchema,
    topic: str | None,
    options: RegisterOptions,
) -> list[StateLog]:
    """The robot's logs; those that hold the tool's pose and no joints become pairs of poses."""
    from measure_learning.core.sightings import is_sparse
    from measure_learning.robots.headings import ToolHeadings
    from measure_learning.robots.logs import is_table, of_instants
    from measure_learning.robots.tables import TableFile

    if is_sparse(tracks[0]):
        schema = of_instants(logs[0], schema, tracks[0].measured().times_s)
    if not all(is_table(path) for path in logs) or not all(
        ToolHeadings.of(TableFile.open(path, schema.log.delimiter).schema.names) for path in logs
    ):
        return list(open_logs([track.name for track in tracks], logs, schema, topic))
    if schema.chain is not None and options.angles is None:
        try:
            return list(open_logs([track.name for track in tracks], logs, schema, topic))
        except EstimatorError as problem:
            if "lacks" not in str(problem):
                raise
    first = [t.inverted() if options.eye_in_hand else t for t in tracks[: len(logs)]]
    read = [_tool_poses(path, t, schema, options) for path, t in zip(logs, first, strict=True)]
    return read * len(tracks) if len(read) == 1 else read


def _tool_poses(
    path: Path, track: PoseTrack, schema: StateSchema, options: RegisterOptions
) -> StateLog:
    """The tool's poses of a log, read as they fit the track best."""
    from measure_learning.core.registration import LoggedTrack, choose_reading, turns_apart_deg
    from measure_learning.robots.tool_poses import read_tool_poses

    readings, read = zip(*read_tool_poses(path, schema, options.angles), strict=True)
    apart = [0.0]
    if len(read) > 1 and track.rotations is not None:
        apart = [turns_apart_deg(LoggedTrack(track, log), options) for log in read]
    best, words = choose_reading(path.name, readings, apart)
    _log.warning("%s", words)
    log = read[best]
    if said := str(new := NewStates.of(log.times_s, steps_mm(log.schema, log.states))):
        _log.warning("%s: %s", path, said)
    return replace(log, times_s=log.times_s[new.rows], states=log.states[new.rows])

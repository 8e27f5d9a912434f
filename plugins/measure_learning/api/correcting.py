"""Correcting a robot's reported position: recorded states, online by UDP, and for the viewer."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from measure.api.outputs import check_file
from measure.arrays import Floats, Ints
from measure.errors import ConfigError, EstimatorError
from measure.results import Run, read_run
from measure.robots import StateSchema
from measure.session import open_session
from measure_learning import SHIPPED
from measure_learning.api.pairing import read_tracks
from measure_learning.onnx import OnnxModel
from measure_learning.robots import find_schema

if TYPE_CHECKING:
    from measure_learning.core import DriftMonitor, EstimateServer, EstimatorEvaluation, Zeroing
    from measure_learning.core.recalibration import ChosenPoses


def rezero(model_path: Path, stretch: Path) -> tuple[Zeroing, DriftMonitor]:
    """What a restart left, from a short measured data set, and what that says of drift."""
    from measure_learning import core as learning

    return learning.rezero(OnnxModel.load(model_path), learning.files.read_dataset(stretch))


POSES = 20
"""Poses of a morning that are chosen by default."""


def choose_poses(model_path: Path, poses: Path, out: Path, count: int = POSES) -> ChosenPoses:
    """Choose poses that the arm is to visit, and write them as a table.

    Args:
        poses: a log, a data set or a table of poses that the arm may visit.
        out: `.csv`: the number of each pose, its row in `poses`, and the state there.
    """
    from measure_learning import core as learning
    from measure_learning.core.recalibration import pose_columns

    if out.suffix != ".csv":
        raise EstimatorError(f"{out}: the name of a file of poses must end with .csv")
    model = OnnxModel.load(model_path)
    chosen = learning.choose_poses(model, poses, count)
    columns = pose_columns(model.schema, chosen)
    np.savetxt(
        out,
        np.column_stack(list(columns.values())),
        ["%d", "%d", *["%.9g"] * len(model.schema.names)],
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    return chosen


def recalibrate(
    model_path: Path, poses: Path, measured: Path, out: Path, arm_files: Sequence[Path] = ()
) -> dict[str, Any]:
    """Joint zeros and links of today, in files; gives the certificate.

    Writes `out`, the model with today's offsets, and beside it, with its name, `.certificate.json`
    and `.certificate.md`; where the chain is known `.urdf`, the robot with today's links and zeros;
    each of `arm_files` (kinematic files of a dVRK) with the zeros added, by its name.

    Args:
        poses: where the arm works: a log, a data set or a table.
        measured: a data set of the poses that were visited.
    """
    from measure_learning import core as learning
    from measure_learning.core import recalibration
    from measure_learning.robots.other_programs import dvrk_with_offsets
    from measure_learning.robots.urdf import joint_names, urdf_text

    if out.suffix != ".onnx":
        raise EstimatorError(f"{out}: a model's file name must end with .onnx")
    model = OnnxModel.load(model_path)
    chain = model.schema.chain
    if chain is None and arm_files:
        raise EstimatorError(f"{model_path}: knows no joints of {model.robot}: no zeros are found")
    found = recalibration.recalibrate(model, learning.files.read_dataset(measured))
    facts = recalibration.certificate(found, recalibration.read_candidates(poses, model)[1])
    out.write_bytes(recalibration.corrected_model(found, model_path.read_bytes()))
    beside = out.with_suffix(".certificate.json")
    beside.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    text = recalibration.certificate_text(facts)
    beside.with_suffix(".md").write_text(text, encoding="utf-8")
    if chain is None:
        return facts
    text = urdf_text(model.robot, joint_names(model.schema), found.zeroing.today)
    out.with_suffix(".urdf").write_text(text, encoding="utf-8")
    slides = [joint.prismatic for joint in chain.joints]
    zeros = np.where(slides, 1e-3, 1.0) * found.zeroing.joints()[0]
    named = named_by_logs(model.schema, zeros.tolist())
    for path in arm_files:
        file = out.with_suffix(f".{path.name}")
        file.write_text(dvrk_with_offsets(path, named), encoding="utf-8")
    return facts


def named_by_logs(schema: StateSchema, values: Sequence[float]) -> dict[str, float]:
    """Values of the joints under all names that logs give to them."""
    own = [reading.terms[0][0] for reading in schema.joints]
    out = dict(zip(own, values, strict=True))
    for other in schema.log.names:
        if list(other.features) == own:
            out |= dict(zip(other.columns, values, strict=True))
    return out


def estimate_file(
    model_path: Path,
    states: Path,
    out: Path,
    zeroing: Zeroing | None = None,
    *,
    true_positions: Path | None = None,
    frame: Path | None = None,
    on_drift: Callable[[str], None] | None = None,
) -> dict[str, int]:
    """Correct recorded states of any number; `core.correct_file` says what is written.

    Args:
        out: `.parquet` or `.csv`.
        true_positions: a table of measured tip positions (`core.files.read_poses`) on the clock
            of the states: each corrects what follows it.
        frame: that the labels were measured by: the covariances hold its base and tool, too.
        on_drift: gets a line that says whether they fit.

    Returns:
        How many were corrected, how many refused and why.
    """
    from measure_learning import core as learning
    from measure_learning.core.frames import read_frame

    if out.suffix not in (".parquet", ".csv"):
        raise EstimatorError(f"{out}: the name of a file of errors must end with .parquet or .csv")
    model = OnnxModel.load(model_path)
    true = None if true_positions is None else learning.files.read_poses(true_positions)
    follower = None if true is None else learning.follower_of(model)
    known = None if frame is None else read_frame(frame)
    counts = learning.correct_file(states, model, out, zeroing, follower, true, known)
    if follower is not None and on_drift is not None:
        on_drift(follower.monitor.sentence())
    return counts


def estimate_online(
    model_path: Path,
    address: tuple[str, int],
    *,
    zeroing: Zeroing | None = None,
    seconds: float | None = None,
    realtime: bool = False,
    on_start: Callable[[EstimateServer], None],
    on_state: Callable[[EstimateServer], None],
    on_refusal: Callable[[str], None],
) -> EstimateServer:
    """Answer states by UDP until the time is over or the process is interrupted."""
    from measure_learning import core as learning
    from measure_learning.core.server import claim_realtime

    if seconds is not None and not seconds >= 0:
        raise ConfigError(f"--seconds {seconds:g}: expected a number that is not negative")
    server = learning.EstimateServer(OnnxModel.load(model_path), address, zeroing)
    if realtime and (refused := claim_realtime()):
        on_refusal(refused)
    on_start(server)
    try:
        server.serve(seconds, on_state)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
    return server


def shipped_model() -> Path:
    """The network that comes with this package, trained on the simulated RAVEN-II."""
    return SHIPPED


def model_file(model: Path) -> Path:
    """The file of a model; `shipped` stands for the one that comes along."""
    return shipped_model() if str(model) == "shipped" else model


def correct_simulated_robot(seconds: float = 60.0, seed: int = 7) -> EstimatorEvaluation:
    """What the shipped network, trained on seed 1, does for a restart that it has not seen.

    Judged by the true tip at the true time.
    """
    from measure_learning import core as learning

    pairs = round(seconds * learning.PAPER_PAIRS / learning.PAPER_MINUTES / 60.0)
    data, _ = learning.simulated_dataset(
        minutes=seconds / 60.0,
        pairs=pairs,
        restarts=1,
        seed=seed,
        labels=learning.LabelKind(exact=True),
    )
    return learning.evaluate(data, OnnxModel.load(shipped_model()).predict(data))


def robot_recording(
    run: Path,
    robot: str,
    log: Path | None = None,
    model: Path | None = None,
    frame: Path | None = None,
    clock_offset_s: float | None = None,
) -> Path:
    """Write a robot's reported, measured and corrected positions into the run's `robot.rrd`.

    Args:
        robot: name of a state schema, or a robot.toml.
        log: the robot's log; the session's own if omitted.
        model: an estimator (.onnx), or `shipped`, that corrects the reported positions.
        frame: where the robot is, by `register`; its base is the cameras' world if omitted.
        clock_offset_s: robot minus camera time; estimated from the motion if absent.
    """
    from measure_learning.core.correction import robot_traces
    from measure_learning.recording import write_robot_recording

    path = run / "robot.rrd"
    check_file(path, overwrite=True)  # made by this alone, and whenever it is looked at
    measured = read_run(run)
    log = log or _log_of(measured)
    if log is None:
        raise ConfigError(f"the session of {run} names no robot log: give it with --robot-log")
    estimator = None if model is None else OnnxModel.load(model_file(model))
    schema = find_schema(robot)
    (track,) = read_tracks([run], frame, schema.robot)
    traces = robot_traces(track, log, schema, estimator, clock_offset_s)
    frames = measured.poses["index"].to_numpy()[_nearest(measured.times_s, traces.times_s)]
    write_robot_recording(path, f"{run.resolve().name}: robot", frames, traces)
    return path


def _nearest(times_s: Floats, at_s: Floats) -> Ints:
    """Which of increasing times (n,) is nearest to each of others (m,); the earlier of two."""
    # Not by all differences: robots report a thousand states a second.
    right = np.minimum(np.searchsorted(times_s, at_s), len(times_s) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(at_s - times_s[left] <= times_s[right] - at_s, left, right)


def _log_of(run: Run) -> Path | None:
    """The robot log that a run's session names, if the session is still there."""
    if run.session is None:
        return None
    with open_session(run.session) as opened:
        return opened.robot_log

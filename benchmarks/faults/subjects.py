"""One file of every kind that the program reads, and the commands that read it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib import resources
from io import StringIO
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
from pyarrow import csv, ipc, parquet

from benchmarks.faults import mutating
from benchmarks.faults.mutating import BINARY, TEXT, Mutation
from measure.cli import main
from measure.host import Estimator, Registry
from measure.host.interfaces import quiet
from measure.robots import RobotLog
from measure.session import read_calibration, write_calibration
from measure.simulation import write_session
from measure.simulation.catalogue import webcam_scene
from measure_learning.api import shipped_model
from measure_learning.core import files, split_by_trajectory
from measure_learning.onnx import checkpoint
from measure_learning.robots import raven_schema, write_log
from measure_learning.robots.bags import DEFINITION, MESSAGE
from measure_learning.robots.raven import FIELDS
from measure_learning.simulator import simulate
from tests.bags import Bag
from tests.learning.robots.test_logs import RAVEN_STATE, _write_counted
from tests.results.conftest import CAMERAS, PERIOD_S, measurement, write_truth, written
from tests.session.conftest import write_recording
from tests.simulated.capture import CaptureScene, write_capture

SETS = 8
_ROBOT = """\
robot = "mine"
features = [{name = "pos_x", unit = "um"}, {name = "pos_y"}, {name = "pos_z"}, {name = "jpos_0"}]
position = ["pos_x", "pos_y", "pos_z"]
position_to_mm = 1e-3
joints = [{feature = "jpos_0", scale = 0.017, kind = "turns", alpha_deg = 90.0}]
tool_mm = [0.0, 1.0, 2.0]
"""
_FORMATS = {"anipose": ".toml", "caliscope": ".toml", "opencv": ".yml"}


@dataclass(frozen=True)
class Subject:
    """A kind of file.

    Attributes:
        name: of the kind.
        file: that is changed, below the folder of all seeds.
        words: of the command, with `{}` for that folder.
        mutations: ways to change it.
        run: whether the command measures; its poses are compared then.
    """

    name: str
    file: str
    words: str
    mutations: tuple[Mutation, ...] = TEXT
    run: bool = False


PROFILES = ("paper", "precise")
_RUN = "run {}/SESSION -o {}/new --profile paper --no-recording"
_LOG = "dataset {}/poses.csv --robot-log {}/robot/FILE -o {}/new.parquet --clock-offset-s 0"
_REGISTER = "register {}/tips.csv --robot-log {}/robot/FILE -o {}/new.toml --clock-offset-s 0"
_TRAIN = "train {}/set/set.parquet -o {}/new.onnx --estimator ridge"
_PAIRED = "dataset {}/set/labels.parquet -o {}/new.parquet"
_ESTIMATE = "estimate {}/model.onnx --input {}/robot/FILE --out {}/new.csv"


def _measured(name: str, file: str, *more: Mutation, session: str = "still") -> tuple[Subject, ...]:
    """Of each profile one: the draw of the subject is that of the profile."""
    kinds = (*TEXT, *more) if file.endswith((".toml", ".csv", ".yml")) else (*BINARY, *more)
    words = _RUN.replace("SESSION", session)
    return tuple(
        Subject(
            f"{name}, {profile}", f"{session}/{file}", words.replace("paper", profile), kinds, True
        )
        for profile in PROFILES
    )


SUBJECTS = (
    *_measured("session.toml", "session.toml"),
    *_measured("body.toml", "body.toml"),
    *_measured("calibration.toml", "calibration.toml"),
    *_measured("stamps", "cam1.csv"),
    *_measured("picture", "cam1/000003.jpg", mutating.changed_picture),
    *_measured("first picture", "cam2/000000.jpg", mutating.changed_picture),
    *(
        subject
        for f, end in _FORMATS.items()
        for subject in _measured(f"calibration, {f}", f"{f}{end}", session=f)
    ),
    *_measured("video", "cam0.mp4", session="video"),
    *_measured("video, motion JPEG", "cam1.avi", session="video"),
    Subject(
        "profile",
        "profile.toml",
        _RUN.replace("SESSION", "still").replace("paper", "{}/profile.toml"),
        run=True,
    ),
    Subject("session checked", "still/session.toml", "check {}/still"),
    Subject("truth", "truth.csv", "evaluate {}/run --truth {}/truth.csv"),
    Subject("marks", "marks.csv", "evaluate {}/run --truth {}/truth.csv --marks {}/marks.csv"),
    *(
        Subject(f"run folder: {name}", f"run/{name}", f"{command} {{}}/run", kinds)
        for name, kinds in (
            ("run.toml", TEXT),
            ("body.toml", TEXT),
            ("calibration.toml", TEXT),
            ("poses.parquet", (*BINARY, *[mutating.table] * 5)),
            ("balls.parquet", (*BINARY, *[mutating.table] * 5)),
            ("detections.parquet", (*BINARY, *[mutating.table] * 5)),
        )
        for command in ("report", "evaluate --truth {}/truth.csv", "export -f csv")
    ),
    *(
        Subject(f"journal: {name}", f"journal/{name}.arrows", command, kinds)
        for name in ("poses", "balls", "detections")
        for kinds in ((*BINARY, *[mutating.table] * 5),)
        for command in (
            "report {}/journal",
            "run {}/still -o {}/journal --resume --profile paper --no-recording",
        )
    ),
    *(
        Subject(f"robot log: {name}", f"robot/{name}", words.replace("FILE", name), kinds)
        for name, kinds in (
            ("log.csv", TEXT),
            ("log.parquet", (*BINARY, *[mutating.table] * 5)),
            ("log.mcap", BINARY),
            ("log.bag", BINARY),
        )
        for words in (_LOG, _ESTIMATE)
    ),
    Subject("poses", "poses.csv", _LOG.replace("FILE", "log.parquet")),
    Subject("robot.toml", "robot.toml", _LOG.replace("FILE", "own.csv") + " --robot {}/robot.toml"),
    Subject(
        "estimator",
        "model.onnx",
        _ESTIMATE.replace("FILE", "log.csv"),
        (*BINARY, *[mutating.resealed] * 8),
    ),
    Subject(
        "data set",
        "set.parquet",
        "train {}/set.parquet -o {}/new.onnx --estimator offset",
        (*BINARY, *[mutating.table] * 5),
    ),
    *(
        Subject(f"data-set folder: {name}", f"set/{name}", words, kinds)
        for name, words, kinds in (
            ("set.parquet", _TRAIN, (*BINARY, *[mutating.table] * 5)),
            ("set.card.json", _TRAIN, (*TEXT, mutating.other_json)),
            ("labels.parquet", _PAIRED, (*BINARY, *[mutating.table] * 5)),
        )
    ),
    *(
        Subject(f"ROS 2 bag: {file}", f"robot/{bag}/{file}", words.replace("FILE", bag), kinds)
        for bag, file, kinds in (
            ("sqlite", "metadata.yaml", TEXT),
            ("sqlite", "sqlite.db3", BINARY),
            ("mcap", "metadata.yaml", TEXT),
            ("mcap", "mcap.mcap", BINARY),
        )
        for words in (_LOG, _REGISTER)
    ),
    Subject(
        "checkpoint",
        "net.checkpoint/mlp.pt",
        "train {}/set.parquet -o {}/net.onnx --estimator mlp --set epochs=3 --resume",
        (*BINARY, *[mutating.restored] * 5),
    ),
    *(
        Subject(f"capture: {name}", f"capture/{name}", "calibrate {}/capture -o {}/new.toml", kinds)
        for name, kinds in (
            ("capture.toml", TEXT),
            ("board.toml", TEXT),
            ("markers.csv", TEXT),
            ("marks.csv", TEXT),
        )
    ),
)
"""All kinds."""


def rendered(folder: Path) -> None:
    """A session whose poses can be measured."""
    write_session(webcam_scene(), np.arange(SETS) / 30.0, folder)


def small(folder: Path) -> None:
    """A session of tiny pictures without balls, which costs no time."""
    write_recording(folder)


def write_seeds(
    folder: Path, session: Callable[[Path], object] = rendered, *, robot: bool = True
) -> None:
    """Write a whole file of every kind below a folder.

    Args:
        folder: there already.
        session: writes the recording.
        robot: whether to write the kinds of robots and estimators, too.
    """
    session(folder / "still")
    _write_other_sessions(folder)
    done(_RUN.replace("SESSION", "still").replace("/new", "/journal"), folder)
    _reopen(folder / "journal")
    written(folder / "run", [measurement(k, lost=k == 2) for k in range(SETS)])
    write_truth(folder / "truth.csv", SETS * PERIOD_S)
    rows = [f"{camera.name},{k},red,{300 + k},200" for camera in CAMERAS for k in range(3)]
    (folder / "marks.csv").write_text("\n".join(["camera,frame,ball,u_px,v_px", *rows]) + "\n")
    profile = resources.files("measure") / "profiles" / "paper.toml"
    (folder / "profile.toml").write_bytes(profile.read_bytes())
    write_capture(CaptureScene(), folder / "capture", pictures=False)
    if robot:
        _write_robot(folder)
        _write_checkpoint(folder)


def done(words: str, folder: Path) -> str:
    """Run a command that must succeed; what it said."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()):
        code = main(words.replace("{}", str(folder)).split())
    assert code == 0, words
    return out.getvalue()


def _write_other_sessions(folder: Path) -> None:
    text = (folder / "still/session.toml").read_text()
    calibration = read_calibration(folder / "still/calibration.toml")
    for name, ending in _FORMATS.items():
        shutil.copytree(folder / "still", folder / name)
        write_calibration(folder / name / f"{name}{ending}", calibration, name)
        named = text.replace("calibration.toml", f"{name}{ending}")
        (folder / name / "session.toml").write_text(named)
    shutil.copytree(folder / "still", folder / "video")
    for camera, file, codec in (("cam0", "cam0.mp4", "libx264"), ("cam1", "cam1.avi", "mjpeg")):
        _write_video(folder / "video", camera, file, codec)
        text = text.replace(f'images = "{camera}/*.jpg"', f'video = "{file}"')
        assert file in text
    (folder / "video/session.toml").write_text(text)


def _write_video(session: Path, camera: str, file: str, codec: str) -> None:
    with av.open(str(session / file), "w") as out:
        stream = out.add_stream(codec, rate=30, options={"crf": "1"} if codec != "mjpeg" else {})
        pictures = [
            np.asarray(cv2.imread(str(path)), np.uint8)
            for path in sorted((session / camera).iterdir())
        ]
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p" if codec != "mjpeg" else "yuvj420p"
        for pixels in pictures:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        out.mux(stream.encode(None))


def _reopen(run: Path) -> None:
    """Make a run as a kill leaves it: its tables are streams."""
    for name in ("poses", "balls", "detections"):
        content = parquet.read_table(run / f"{name}.parquet").slice(0, None)
        with (run / f"{name}.arrows").open("wb") as out, ipc.new_stream(out, content.schema) as to:
            to.write_table(content)
        (run / f"{name}.parquet").unlink()
    (run / "summary.json").unlink()


def _write_robot(folder: Path) -> None:
    robot, schema = folder / "robot", raven_schema()
    robot.mkdir()
    run = simulate(24.0, 1, log_hz=20.0)
    log = RobotLog(schema, run.times_s, run.states)
    for name in ("log.csv", "log.parquet", "own.csv"):
        write_log(robot / name, log)
    for name in ("log.bag", "log.mcap"):
        _write_counted(folder / name, RAVEN_STATE)
        made = folder / name
        inner = next(made.glob("*.mcap")) if made.is_dir() else made
        shutil.copy(inner, robot / name)
    x, y, z = schema.position_mm(run.states)[::2].T
    poses = {"time_s": run.times_s[::2], "x_mm": x + 1.0, "y_mm": y, "z_mm": z}
    csv.write_csv(pa.table(poses), folder / "poses.csv")
    chain = schema.chain
    assert chain is not None
    tips = chain.pose(schema.joint_positions(log.states[::8]))
    columns = np.column_stack([log.times_s[::8], tips.translation, tips.quat_wxyz])
    names = ["time_s", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"]
    csv.write_csv(pa.table(dict(zip(names, columns.T, strict=True))), folder / "tips.csv")
    (folder / "robot.toml").write_text(_ROBOT)
    for name in ("sqlite", "mcap"):
        _write_ros2(robot / name, log)
    shutil.copy(shipped_model(), folder / "model.onnx")
    words = _LOG.replace("FILE", "log.parquet").replace("new", "set") + " --cut-s 2"
    done(words, folder)
    (folder / "set").mkdir()
    errors = 1.0 + 0.1 * np.random.default_rng(1).standard_normal((3, len(log.times_s)))
    runs = [f"run{k * 5 // len(log.times_s)}" for k in range(len(log.times_s))]
    states = dict(zip(schema.names, log.states.T.astype(np.float32), strict=True))
    labels = {"run": runs, "t_s": log.times_s, **dict(zip(("ex", "ey", "ez"), errors, strict=True))}
    parquet.write_table(pa.table({**labels, **states}), folder / "set/labels.parquet")
    for ending in (".parquet", ".card.json"):
        shutil.copy(folder / f"set{ending}", folder / "set" / f"set{ending}")


def _write_ros2(path: Path, log: RobotLog) -> None:
    """The folder of a ROS 2 bag of RAVEN-II's states, both arms of which do the same."""
    ends = np.cumsum([field.per_arm for field in FIELDS])
    with Bag(path, f".{path.name}", {MESSAGE: DEFINITION}) as bag:
        for time_s, numbers in zip(log.times_s, log.states, strict=True):
            state: dict[str, Any] = {
                field.name: np.tile(part, 2).astype(np.int32 if field.integer else np.float32)
                for field, part in zip(FIELDS, np.split(numbers, ends[:-1]), strict=True)
            }
            state |= {"runlevel": 3, "sublevel": 0, "last_seq": 0, "hdr": bag.header(time_s)}
            state["dt"] = bag.make("builtin_interfaces/Duration", sec=0, nanosec=1_000_000)
            bag.send("/ravenstate", MESSAGE.replace("/msg", ""), time_s, **state)


def _write_checkpoint(folder: Path) -> None:
    """As a kill leaves it."""
    estimator: Any = Registry.discover().build(Estimator, "mlp", {"epochs": 3})
    estimator.checkpoint = folder / "net.checkpoint"
    split = split_by_trajectory(files.read_dataset(folder / "set.parquet"))
    before, checkpoint.EVERY_S = checkpoint.EVERY_S, 0.0
    try:
        estimator.learn(split.train, split.validation, seed=0, report=quiet)
    finally:
        checkpoint.EVERY_S = before

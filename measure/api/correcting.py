"""Learning a robot's position error and correcting it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from measure.errors import ConfigError, EstimatorError

if TYPE_CHECKING:
    from measure.arrays import Floats
    from measure.host import Dataset, Registry, Report
    from measure.learning import (
        AssemblySettings,
        Corrected,
        DriftMonitor,
        EstimateServer,
        Evaluation,
        Importance,
        SweepState,
        Trained,
        TrajectoryFacts,
    )


def make_dataset(
    runs: Sequence[Path],
    logs: Sequence[Path],
    robot: str,
    out: Path,
    settings: AssemblySettings,
    *,
    topic: str | None = None,
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """Pair runs with robot logs, or take tables that already hold labels, and write a data set.

    Args:
        runs: run folders, files of poses, or (without logs) tables of states and errors.
        logs: robot logs, one for each run or one for all; none for labelled tables.
        robot: name of a state schema, or a robot.toml.
        out: the Parquet file; its data card goes beside it.
        settings: how poses and states are brought together.
        topic: of the state messages, if a log is a bag.

    Raises:
        EstimatorError: files that do not fit; the message says which.
    """
    from measure.learning import assemble, files, join
    from measure.robots import find_schema, read_log

    schema = find_schema(robot)
    facts: list[TrajectoryFacts] = []
    if not logs:
        bare = [path for path in runs if path.is_dir() or not files.has_labels(path)]
        if bare:
            raise EstimatorError(
                f"{bare[0]}: has no labels (run, ex, ey, ez) of its own: give the robot's log "
                "with --robot-log"
            )
        data = join([files.read_labelled(path, schema) for path in runs])
    else:
        if len(logs) not in (1, len(runs)):
            raise EstimatorError(
                f"{len(runs)} runs and {len(logs)} robot logs: give one log for all, or one each"
            )
        read = [read_log(path, schema, topic=topic) for path in logs]
        each = read * len(runs) if len(read) == 1 else read
        tracks = [files.read_poses(path) for path in runs]
        data, facts = assemble(list(zip(tracks, each, strict=True)), settings)
    files.write_dataset(out, data, facts, ", ".join(map(str, [*runs, *logs])))
    return data, facts


def simulate_dataset(
    out: Path, *, minutes: float, pairs: int, restarts: int, seed: int, wear: float, report: Report
) -> tuple[Dataset, list[TrajectoryFacts]]:
    """A data set of the simulated RAVEN-II, written to `out`."""
    from measure.learning import files, simulated_dataset
    from measure.robots.simulator import Cables

    data, facts = simulated_dataset(
        minutes=minutes,
        pairs=pairs,
        restarts=restarts,
        seed=seed,
        cables=Cables(wear=wear),
        report=report,
    )
    source = f"simulated RAVEN-II, {minutes:g} min, {restarts} restarts, seed {seed}, wear {wear:g}"
    files.write_dataset(out, data, facts, source)
    return data, facts


def simulate_recording(
    folder: Path,
    *,
    seconds: float,
    frame_hz: float,
    seed: int,
    clock_offset_s: float,
    wear: float,
    report: Callable[[int, int], None],
) -> None:
    """Render the simulated RAVEN-II with its balls into a session folder, with its log."""
    from measure.learning.rendering import render_recording
    from measure.robots.simulator import Cables

    render_recording(
        folder,
        seconds=seconds,
        frame_hz=frame_hz,
        seed=seed,
        clock_offset_s=clock_offset_s,
        cables=Cables(wear=wear),
        progress=report,
    )


@dataclass(frozen=True)
class TrainOptions:
    """What is trained, and on what.

    Attributes:
        estimator: name of the plugin.
        settings: its settings.
        validation: a data set of its own that chooses, stops and scores; otherwise trajectories
            are split off for that.
        test_share: of the rows, in whole trajectories.
        validation_share: likewise.
        split_seed: of the choice of trajectories.
        seed: of everything random in training.
        resume: go on with an interrupted training of the same file.
        split_rows: split by random rows: wrong, and only there to show how wrong.
        notes: lines for the model card.
    """

    estimator: str = "stream"
    settings: Mapping[str, Any] | None = None
    validation: Path | None = None
    test_share: float = 0.1
    validation_share: float = 0.1
    split_seed: int = 0
    seed: int = 0
    resume: bool = False
    split_rows: bool = False
    notes: Mapping[str, str] | None = None


def train(
    data: Sequence[Path], out: Path, options: TrainOptions, registry: Registry, report: Report
) -> Trained:
    """Fit an estimator and write `out` (ONNX), its card and its report.

    Raises:
        EstimatorError: data that cannot be learnt from.
        PluginError, ConfigError: the estimator or its settings.
    """
    import json

    from measure import learning
    from measure.viewing.report.estimator_report import write_estimator_report

    estimator = registry.estimator(options.estimator, dict(options.settings or {}))
    whole = learning.join([learning.files.read_dataset(path) for path in data])
    if options.validation is not None:
        other = learning.files.read_dataset(options.validation)
        learning.same_robot(whole, other)
        split = learning.Split(whole, other, other)
    else:
        cut = learning.split_by_rows if options.split_rows else learning.split_by_trajectory
        split = cut(
            whole,
            test=options.test_share,
            validation=options.validation_share,
            seed=options.split_seed,
        )
    trained = learning.train(
        estimator,
        split,
        out,
        seed=options.seed,
        report=report,
        resume=options.resume,
        notes=options.notes,
    )
    card = json.loads(out.with_suffix(".card.json").read_text())
    write_estimator_report(trained, card, out.with_suffix(".report.html"))
    return trained


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Read NAME=VALUE; a value is TOML, or else a bare word.

    Raises:
        ConfigError: there is no "=".
    """
    import tomllib

    out: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: expected NAME=VALUE")
        try:
            out[name.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            out[name.strip()] = value
    return out


def sweep(
    data: Path,
    space: Path,
    journal: Path,
    *,
    estimator: str,
    settings: Mapping[str, Any],
    trials: int,
    seed: int,
    scheduler: str | None,
    report: Report,
) -> SweepState:
    """Help a sweep along until it has enough trials."""
    from measure.learning import sweeping

    job = sweeping.SweepJob(str(data.resolve()), estimator, dict(settings), seed)
    return sweeping.sweep(
        job, sweeping.read_space(space), journal, trials, scheduler=scheduler, report=report
    )


def ablate(
    data: Path,
    model_path: Path,
    *,
    single: bool,
    remove: bool,
    split_seed: int,
    registry: Registry,
    report: Report,
) -> tuple[float, list[Importance]]:
    """Rank a model's inputs by what their loss costs on the test trajectories."""
    from measure import learning
    from measure.host import OnnxModel

    model = OnnxModel.load(model_path)
    split = learning.split_by_trajectory(learning.files.read_dataset(data), seed=split_seed)
    model.check(split.test.schema)
    groups = (learning.single_fields if single else learning.field_groups)(split.test)
    refit = None
    if remove:
        name, settings = str(model.facts["estimator"]), dict(model.facts["settings"])
        refit = lambda: registry.estimator(name, settings)  # noqa: E731
    return learning.ablate(model, split, groups, refit=refit, seed=split_seed, report=report)


def rezero(model_path: Path, stretch: Path) -> tuple[Floats, Floats, DriftMonitor]:
    """Offset and SD (3,) from a short measured data set, and what it says of drift."""
    from measure import learning
    from measure.host import OnnxModel

    return learning.rezero(OnnxModel.load(model_path), learning.files.read_dataset(stretch))


def estimate_file(
    model_path: Path, states: Path, out: Path | None, offset_mm: Floats | None = None
) -> Corrected:
    """Correct recorded states; write `run, i, t_s, ex, ey, ez, sd_mm, unfamiliar` if `out`.

    Raises:
        EstimatorError: the model or the states do not fit.
    """
    from measure import learning
    from measure.host import OnnxModel

    model = OnnxModel.load(model_path)
    table = learning.read_states(states, model)
    corrected = learning.correct(table, model, offset_mm)
    if out is not None:
        learning.write_corrected(out, table, corrected)
    return corrected


def estimate_online(
    model_path: Path,
    address: tuple[str, int],
    *,
    offset_mm: Floats | None = None,
    seconds: float | None = None,
    started: Callable[[EstimateServer], None],
    tell: Callable[[EstimateServer], None],
) -> EstimateServer:
    """Answer states by UDP until the time is over or the process is interrupted."""
    from measure import learning
    from measure.host import OnnxModel

    server = learning.EstimateServer(OnnxModel.load(model_path), address, offset_mm)
    started(server)
    try:
        server.serve(seconds, tell)
    except KeyboardInterrupt:
        pass
    finally:
        server.close()
    return server


def shipped_model() -> Path:
    """The network that comes with this package, trained on the simulated RAVEN-II."""
    return Path(__file__).parents[1] / "learning" / "models" / "raven_simulated.onnx"


def correct_simulated_robot(seconds: float = 60.0, seed: int = 7) -> Evaluation:
    """What the shipped network does for a restart of the simulated robot it has not seen.

    Args:
        seconds: of teleoperation.
        seed: of motion and restart; the network was trained on seed 1.
    """
    from measure import learning
    from measure.host import OnnxModel

    pairs = round(seconds * learning.PAPER_PAIRS / learning.PAPER_MINUTES / 60.0)
    data, _ = learning.simulated_dataset(minutes=seconds / 60.0, pairs=pairs, restarts=1, seed=seed)
    return learning.evaluate(data, OnnxModel.load(shipped_model()).predict(data))

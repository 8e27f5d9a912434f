"""Fitting estimators, searching their settings, ranking their inputs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from measure.api.outputs import check_file, output
from measure.api.profiles import parse_value
from measure.errors import ConfigError, EstimatorError
from measure.host import Estimator, Registry, Report
from measure_learning.onnx import OnnxModel

if TYPE_CHECKING:
    from measure_learning.core import Importance, Split, SweepState, Trained


@dataclass(frozen=True)
class TrainOptions:
    """What is trained, and by which labels it is judged.

    Attributes:
        estimator: a plugin: stream (default), mlp (the paper's), ridge, gp, offset, kinematic;
            or "stream after kinematic", which learns what the latter leaves.
        seed: of everything random in training.
        resume: continue an interrupted training.
        overwrite: Replace what is there.
        validation: a data set of its own to choose and stop by, instead of a split; it also scores
            if there is no test set.
        test: a data set of its own to score by.
        test_share: share of the labels kept for the test, in whole trajectories.
        validation_share: the same for choosing and stopping.
        split_seed: which trajectories those are.
        folds: groups of recordings left out in turn, in fits of their own, to judge the covariance;
            0 leaves none out.
    """

    estimator: str = "stream"
    seed: int = 0
    resume: bool = False
    overwrite: bool = False
    validation: Path | None = None
    test: Path | None = None
    test_share: float = 0.1
    validation_share: float = 0.1
    split_seed: int = 0
    folds: int = 4


def train(
    data: Sequence[Path],
    out: Path,
    options: TrainOptions,
    registry: Registry,
    report: Report,
    settings: Mapping[str, Any] | None = None,
    notes: Mapping[str, str] | None = None,
) -> Trained:
    """Fit an estimator and write `out` (ONNX), its card with `notes`, and its report."""
    from measure_learning import core as learning
    from measure_learning.report import estimator_report

    read = [*data, *(path for path in (options.validation, options.test) if path)]
    cards = [path.with_suffix(".card.json") for path in read if path.name]
    beside = ".card.json", ".card.md", ".report.html"
    with output(out, options.overwrite, [*read, *cards], beside) as file:
        check_seeds(split_seed=options.split_seed, seed=options.seed)
        if options.folds < 0 or options.folds == 1:
            raise ConfigError(f"--folds {options.folds}: expected 2 groups or more, or 0 for none")
        estimator = registry.build(Estimator, options.estimator, dict(settings or {}))
        estimator.folds = options.folds
        trained = learning.train(
            estimator,
            _split(data, options),
            file,
            seed=options.seed,
            report=report,
            checkpoint=out.with_suffix(".checkpoint"),
            resume=options.resume,
            notes=notes,
        )
        card, _, page = map(file.with_suffix, beside)
        made = estimator_report(trained, json.loads(card.read_text("utf-8")))
        page.write_text(made, encoding="utf-8")
    return replace(trained, path=out)


def _split(data: Sequence[Path], options: TrainOptions) -> Split:
    from measure_learning import core as learning

    whole = learning.join([learning.files.read_dataset(path) for path in data])
    other, test = (
        None if path is None else learning.files.read_dataset(path)
        for path in (options.validation, options.test)
    )
    learning.same_robot([whole, *(part for part in (other, test) if part is not None)])
    if test is not None and (shared := set(test.present()) & set(whole.present())):
        raise EstimatorError(
            f"{options.test}: trajectory '{min(shared)}' is among those to learn from: test with "
            "others"
        )
    if other is not None:
        return learning.Split(whole, other, test or other)
    return learning.split_by_trajectory(
        whole,
        test=test or options.test_share,
        validation=options.validation_share,
        seed=options.split_seed,
    )


def parse_settings(texts: Sequence[str]) -> dict[str, Any]:
    """Read NAME=VALUE; a value is TOML, or else a bare word. ConfigError without "="."""
    out: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: expected NAME=VALUE")
        out[name.strip()] = parse_value(value)
    return out


@dataclass(frozen=True)
class SweepOptions:
    """What a sweep searches.

    Attributes:
        estimator: the plugin.
        trials: finished trials wanted in all.
        split_seed: which trajectories validate.
        cluster: a dask scheduler's address, tcp://HOST:PORT, whose workers run the trials.
    """

    estimator: str = TrainOptions.estimator
    trials: int = 100
    split_seed: int = 0
    cluster: str | None = None


def sweep(
    data: Path,
    space: Path,
    journal: Path,
    options: SweepOptions,
    report: Report,
    settings: Mapping[str, Any] | None = None,
) -> SweepState:
    """Run trials until the sweep has enough, together with other processes of the same journal.

    All trials share the `settings`.
    """
    settings = settings or {}
    from measure_learning.core import files, sweeping

    if options.trials < 1:
        raise ConfigError(f"--trials {options.trials}: expected a positive number")
    check_seeds(split_seed=options.split_seed)
    check_file(journal, overwrite=True)  # what is there goes on
    ranges = sweeping.read_space(space)
    if both := sorted(ranges.keys() & settings.keys()):
        raise ConfigError(f"--set {both[0]}: {space} has a range for it: give it in one place only")
    digest = files.read_dataset(data).digest()
    job = sweeping.SweepJob(
        str(data.resolve()), options.estimator, dict(settings), options.split_seed, digest
    )
    return sweeping.sweep(
        job, ranges, journal, options.trials, cluster=options.cluster, report=report
    )


def ablate(
    data: Sequence[Path],
    model_path: Path,
    *,
    single: bool,
    remove: bool,
    split_seed: int | None,
    registry: Registry,
    report: Report,
) -> tuple[float, list[Importance]]:
    """Rank a model's inputs by what their loss costs on the test trajectories.

    Args:
        data: all that the model was trained on.
        single: every feature on its own instead of the robot's groups.
        remove: also fit without each.
        split_seed: split the data anew instead of as in training.
    """
    from measure_learning import core as learning

    check_seeds(split_seed=split_seed or 0)
    model = OnnxModel.load(model_path)
    whole = learning.join([learning.files.read_dataset(path) for path in data])
    model.check(whole.schema)
    if split_seed is None:
        split = learning.split_as_trained(whole, model)
    else:
        split = learning.split_by_trajectory(whole, seed=split_seed)
    groups = learning.field_groups(split.test, single=single)
    refit = None
    if remove:
        name, settings = str(model.facts["estimator"]), dict(model.facts["settings"])
        refit = lambda: registry.build(Estimator, name, settings)  # noqa: E731
    return learning.ablate(model, split, groups, refit=refit, seed=split_seed or 0, report=report)


_LARGEST = 2**32 - 1


def check_seeds(**seeds: int) -> None:
    """Refuse (ConfigError) seeds, by the names of their options, that not every generator takes."""
    for name, seed in seeds.items():
        if not 0 <= seed <= _LARGEST:
            option = "--" + name.replace("_", "-")
            raise ConfigError(f"{option} {seed}: expected a number from 0 to {_LARGEST}")

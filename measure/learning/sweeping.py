"""Searching an estimator's settings: optuna on a shared journal, or dask workers."""

from __future__ import annotations

import json
import os
import time
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from measure.errors import EstimatorError
from measure.host import Registry, Report
from measure.learning.files import read_dataset
from measure.learning.scores import Score
from measure.learning.splits import split_by_trajectory

_LEAST_PATIENCE_S = 600.0


class Range(BaseModel):
    """What one setting may be: a list of choices, or numbers between two limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    choices: list[Any] | None = None
    low: float | None = None
    high: float | None = None
    log: bool = False
    integer: bool = False


@dataclass(frozen=True)
class SweepJob:
    """One trial's work, as plain values that travel to another process or machine.

    Attributes:
        data: the data set's file, reachable from every worker.
        estimator: its name.
        settings: fixed for all trials.
        seed: of split and fit.
    """

    data: str
    estimator: str
    settings: Mapping[str, Any]
    seed: int


@dataclass(frozen=True)
class SweepState:
    """How far a sweep is: finished, failed, running, and the best trials as (mm, settings)."""

    finished: int
    failed: int
    running: int
    best: tuple[tuple[float, dict[str, Any]], ...]


def read_space(path: Path) -> dict[str, Range]:
    """Read a search space: a TOML table per setting.

    Raises:
        EstimatorError: missing, not TOML, or a table that makes no sense.
    """
    try:
        tables = tomllib.loads(path.read_text())
        return {name: Range.model_validate(table) for name, table in tables.items()}
    except OSError:
        raise EstimatorError(f"{path}: no such search space") from None
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise EstimatorError(f"{path}: {' '.join(str(error).split())[:200]}") from None


def run_trial(job: SweepJob, settings: Mapping[str, Any]) -> float:
    """Fit with some settings; RMS in mm on the validation trajectories."""
    from measure.host.estimator import quiet

    data = read_dataset(Path(job.data))
    split = split_by_trajectory(data, seed=job.seed)
    registry = Registry.discover()
    estimator = registry.estimator(job.estimator, {**job.settings, **settings})
    estimator.fit(split.train, split.validation, seed=job.seed, report=quiet)
    model = getattr(estimator, "model", None)
    if model is None:
        raise EstimatorError(f"estimator '{job.estimator}' cannot be judged: it has no model")
    estimates = model.predict(split.validation)
    used = split.validation.usable
    return Score.of((split.validation.errors_mm - estimates.errors_mm)[used]).rms_mm


def sweep(
    job: SweepJob,
    space: Mapping[str, Range],
    journal: Path,
    trials: int,
    *,
    scheduler: str | None = None,
    report: Report,
) -> SweepState:
    """Work on a sweep until it has `trials` finished trials; every process that calls this helps.

    The journal is a file that any number of processes and machines append to. The settings of a
    worker that was killed are tried again by another: at once on the same machine, elsewhere after
    ten times the longest trial so far, and ten minutes at least.

    Args:
        job: what a trial does.
        space: what is searched.
        journal: the sweep's file; started if absent.
        trials: finished trials wanted in all, by all workers.
        scheduler: address of a dask scheduler whose workers run the trials; None runs them here.
        report: progress.

    Raises:
        EstimatorError: an extra is missing, or the journal is of another sweep.
    """
    study = _open(job, journal)
    while True:
        _requeue_dead(study)
        state = sweep_state(study)
        report(min(1.0, state.finished / trials), f"{state.finished} of {trials} trials")
        if state.finished >= trials:
            return state
        if state.finished + state.running >= trials and not _queued(study):
            time.sleep(0.5)
            continue
        if scheduler:
            _dask_batch(study, job, space, scheduler, trials - state.finished)
        else:
            _one(study, job, space)


def sweep_state(study: Any) -> SweepState:
    """Counts and the ten best trials."""
    import optuna

    states = optuna.trial.TrialState
    trials = study.get_trials(deepcopy=False)
    done = [t for t in trials if t.state == states.COMPLETE]
    best = sorted(done, key=lambda t: t.value)[:10]
    return SweepState(
        len(done),
        sum(t.state == states.FAIL for t in trials),
        sum(t.state == states.RUNNING for t in trials),
        tuple((float(t.value), _chosen(t.params)) for t in best),
    )


def _chosen(params: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as settings: a choice is kept as JSON, for a list cannot be one of optuna's."""
    return {k: json.loads(v) if isinstance(v, str) else v for k, v in params.items()}


def _open(job: SweepJob, journal: Path) -> Any:
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
    except ImportError:
        raise EstimatorError(
            "a sweep needs the extra 'sweep': pip install 'triball[sweep]'"
        ) from None
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal.parent.mkdir(parents=True, exist_ok=True)
    storage = JournalStorage(
        JournalFileBackend(str(journal), lock_obj=JournalFileOpenLock(str(journal)))
    )
    study = optuna.create_study(
        study_name="sweep",
        storage=storage,
        load_if_exists=True,
        sampler=optuna.samplers.TPESampler(constant_liar=True),
    )
    identity = json.dumps([job.data, job.estimator, dict(job.settings), job.seed])
    written = study.user_attrs.get("job")
    if written is None:
        study.set_user_attr("job", identity)
    elif written != identity:
        raise EstimatorError(f"{journal}: belongs to another sweep ({written}): use another file")
    return study


def _suggest(trial: Any, space: Mapping[str, Range]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, range_ in space.items():
        if range_.choices is not None:
            text = trial.suggest_categorical(name, [json.dumps(c) for c in range_.choices])
            out[name] = json.loads(text)
        elif range_.low is None or range_.high is None:
            raise EstimatorError(f"'{name}': give choices, or low and high")
        elif range_.integer:
            out[name] = trial.suggest_int(name, int(range_.low), int(range_.high), log=range_.log)
        else:
            out[name] = trial.suggest_float(name, range_.low, range_.high, log=range_.log)
    return out


def _one(study: Any, job: SweepJob, space: Mapping[str, Range]) -> None:
    trial = study.ask()
    trial.set_user_attr("worker", f"{os.uname().nodename}:{os.getpid()}")
    settings = _suggest(trial, space)
    _finish(study, trial, lambda: run_trial(job, settings))


def _finish(study: Any, trial: Any, work: Any) -> None:
    import optuna

    try:
        value = work()
    except EstimatorError:
        raise
    except (ArithmeticError, ValueError, RuntimeError) as error:
        trial.set_user_attr("error", str(error)[:300])
        study.tell(trial, state=optuna.trial.TrialState.FAIL)
        return
    if np.isfinite(value):
        study.tell(trial, value)
    else:
        trial.set_user_attr("error", "the score is not a number")
        study.tell(trial, state=optuna.trial.TrialState.FAIL)


def _requeue_dead(study: Any) -> None:
    """Give back what dead workers were trying: their settings are queued for the next worker."""
    import optuna

    trials = study.get_trials(deepcopy=False)
    took = [t.duration.total_seconds() for t in trials if t.duration is not None]
    patience_s = max(_LEAST_PATIENCE_S, 10.0 * max(took, default=0.0))
    for trial in trials:
        if trial.state != optuna.trial.TrialState.RUNNING or not _abandoned(trial, patience_s):
            continue
        try:
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        except (ValueError, RuntimeError):
            continue  # another worker was faster
        study.enqueue_trial(trial.params)


def _abandoned(trial: Any, patience_s: float) -> bool:
    """A worker of this machine is known to be gone; one of another is given up after a while."""
    host, _, pid = trial.user_attrs.get("worker", "").rpartition(":")
    if host == os.uname().nodename:
        return not _alive(int(pid))
    return bool((datetime.now() - trial.datetime_start).total_seconds() > patience_s)


def _queued(study: Any) -> bool:
    import optuna

    return any(t.state == optuna.trial.TrialState.WAITING for t in study.get_trials(deepcopy=False))


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _dask_batch(
    study: Any, job: SweepJob, space: Mapping[str, Range], scheduler: str, wanted: int
) -> None:
    """Hand a batch to dask's workers; dask itself repeats what a dead worker was doing."""
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise EstimatorError(
            "a scheduler needs the extra 'cluster': pip install 'triball[cluster]'"
        ) from None
    with Client(scheduler) as client:
        workers = max(1, len(client.scheduler_info()["workers"]))
        asked: dict[Any, Any] = {}
        for _ in range(min(wanted, 2 * workers)):
            trial = study.ask()
            asked[client.submit(run_trial, job, _suggest(trial, space), pure=False)] = trial
        for future in as_completed(list(asked)):
            _finish(study, asked[future], future.result)

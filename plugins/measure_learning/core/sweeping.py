"""Searching an estimator's settings: optuna on a file that processes share."""

from __future__ import annotations

import json
import platform
import sqlite3
import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, RootModel, model_validator

from measure.api.spreading import Workers, spread
from measure.errors import DivergedError, EstimatorError, FitError
from measure.host import Estimator, Registry, Report
from measure.host.interfaces import quiet
from measure.processes import needed
from measure.session import load_toml
from measure_learning.core.files import read_dataset
from measure_learning.core.scores import corrected_rms_mm, fit, split_by_trajectory

_HEARTBEAT_S = 15  # a busy machine delays some
_LOCKED_S = 60.0  # how long a process waits for another one that writes
_UNFIT = (DivergedError, FitError, ArithmeticError, ValueError, RuntimeError)
"""What settings raise that an estimator cannot be fitted with: their trial fails, no other."""


class Range(BaseModel):
    """Search range of a setting: a list of choices, or numbers between two limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    choices: Annotated[list[Any], Field(min_length=1)] | None = None
    low: FiniteFloat | None = None
    high: FiniteFloat | None = None
    log: bool = False
    integer: bool = False

    @model_validator(mode="after")
    def _is_complete(self) -> Range:
        if self.choices is not None:
            return self
        if self.low is None or self.high is None:
            raise ValueError("give choices, or low and high")
        if self.low > self.high:
            raise ValueError(f"low ({self.low:g}) must not be above high ({self.high:g})")
        if self.log and self.low <= 0:
            raise ValueError(f"low is {self.low:g}: log needs more than 0")
        if self.integer and (self.low % 1 or self.high % 1):
            raise ValueError("low and high must be whole numbers, as integer says")
        return self


class _Space(RootModel[dict[str, Range]]):
    """By setting."""


@dataclass(frozen=True)
class SweepState:
    """Numbers of trials in each state, and the best as (mm, settings)."""

    best: tuple[tuple[float, dict[str, Any]], ...]
    finished: int
    failed: int
    running: int
    waiting: int  # to be tried again


def read_space(path: Path) -> dict[str, Range]:
    """Read a search space: a TOML table per setting; EstimatorError with its line."""
    return load_toml(path, _Space, EstimatorError).root


def sweep_state(study: Any) -> SweepState:
    """Counts and the ten best trials."""
    import optuna

    states = optuna.trial.TrialState
    counted = (states.COMPLETE, states.FAIL, states.RUNNING, states.WAITING)
    trials = [study.get_trials(False, (state,)) for state in counted]
    best = sorted(trials[0], key=lambda t: t.value)[:10]
    # A choice is kept as JSON, for a list cannot be one of optuna's.
    chosen = [
        (t.value, {k: json.loads(v) if isinstance(v, str) else v for k, v in t.params.items()})
        for t in best
    ]
    return SweepState(tuple(chosen), *map(len, trials))


@contextmanager
def open_study(journal: Path, identity: str, heartbeat_s: int = _HEARTBEAT_S) -> Iterator[Any]:
    """The study in a journal, an SQLite file; it is begun if absent.

    Optuna gives a trial up whose process gave no sign of life for three times `heartbeat_s`, and
    queues its settings for the next one. EstimatorError: the file is not this sweep's.
    """
    optuna = needed("optuna", "sweep", "a sweep", EstimatorError)
    from optuna.storages.journal import JournalFileOpenLock
    from sqlalchemy.exc import SQLAlchemyError

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal.parent.mkdir(parents=True, exist_ok=True)
    lock = JournalFileOpenLock(str(journal))  # two processes may begin the same file
    lock.acquire()
    try:
        _check_journal(journal)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            storage = _storage(journal, heartbeat_s)
        study = optuna.create_study(
            study_name="sweep",
            storage=storage,
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(constant_liar=True),
        )
        written = study.user_attrs.get("job")
        if written is None:
            study.set_user_attr("job", identity)
    except (SQLAlchemyError, sqlite3.Error, optuna.exceptions.OptunaError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]
        raise EstimatorError(
            f"{journal}: damaged, or not a sweep's journal ({reason}): use another file"
        ) from None
    finally:
        lock.release()
    try:
        if written not in (None, identity):
            raise EstimatorError(
                f"{journal}: belongs to another sweep, or the data have changed since ({written} "
                f"then, {identity} now): use another file"
            )
        yield study
    finally:
        storage.remove_session()
        storage.engine.dispose()


def _storage(journal: Path, heartbeat_s: int) -> Any:
    import optuna

    return optuna.storages.RDBStorage(
        "sqlite:///sweep",  # the dialect: a URL cannot hold every file's name
        {"creator": partial(sqlite3.connect, journal, timeout=_LOCKED_S, check_same_thread=False)},
        heartbeat_interval=heartbeat_s,
        grace_period=3 * heartbeat_s,
        heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(),
    )


def _check_journal(journal: Path) -> None:
    """Refuse a file of something else before optuna makes its tables there (sqlite3.Error)."""
    with closing(sqlite3.connect(journal)) as file:
        tables = {name for (name,) in file.execute("SELECT name FROM sqlite_master")}
    if tables and "studies" not in tables:
        raise sqlite3.DatabaseError("its tables are another program's")


def _suggest(trial: Any, space: Mapping[str, Range]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, range_ in space.items():
        if range_.choices is not None:
            text = trial.suggest_categorical(name, [json.dumps(c) for c in range_.choices])
            out[name] = json.loads(text)
            continue
        assert range_.low is not None
        assert range_.high is not None
        if range_.integer:
            out[name] = trial.suggest_int(name, int(range_.low), int(range_.high), log=range_.log)
        else:
            out[name] = trial.suggest_float(name, range_.low, range_.high, log=range_.log)
    return out


def failures(study: Any) -> list[str]:
    """Reasons of the failed trials, in order, without those of dead workers."""
    trials = study.get_trials(deepcopy=False)
    return [trial.user_attrs["error"] for trial in trials if "error" in trial.user_attrs]


@dataclass(frozen=True)
class SweepJob:
    """One trial's work, as plain values that travel to another process or machine."""

    data: str  # the data set's file, reachable from every worker
    estimator: str
    settings: Mapping[str, Any]  # fixed for all trials
    seed: int  # of split and fit
    digest: str

    @property
    def identity(self) -> str:
        """Text that is the same for all trials of a sweep, wherever the data lie."""
        return json.dumps([self.estimator, dict(self.settings), self.seed, self.digest])


def run_trial(job: SweepJob, settings: Mapping[str, Any]) -> float:
    """Fit with some settings; RMS in mm on the validation recordings."""
    data = read_dataset(Path(job.data))
    if data.digest() != job.digest:
        raise EstimatorError(f"{job.data}: has changed since the sweep began: use another journal")
    split = split_by_trajectory(replace(data, turns=None), seed=job.seed)
    registry = Registry.discover()
    estimator = registry.build(Estimator, job.estimator, {**job.settings, **settings})
    estimator.folds = 0  # the score is of corrections, not of covariances
    fit(estimator, split.train, split.validation, seed=job.seed, report=quiet)
    model = getattr(estimator, "model", None)
    if model is None:
        raise EstimatorError(f"estimator '{job.estimator}' cannot be judged: it has no model")
    return corrected_rms_mm(model, split.validation)


def sweep(
    job: SweepJob,
    space: Mapping[str, Range],
    journal: Path,
    trials: int,
    *,
    cluster: str | None = None,
    report: Report,
    heartbeat_s: int = _HEARTBEAT_S,
) -> SweepState:
    """Work on a sweep until it has `trials` finished trials; every process that calls this helps.

    This process runs the trials, or the workers of a dask cluster do. EstimatorError: an extra is
    missing, the journal is damaged or of another sweep, or as many trials failed as were wanted.
    """
    workers = Workers(1, cluster)

    def score(trial: Any) -> float:
        try:
            settings = _suggest(trial, space)
        except ValueError as error:
            raise EstimatorError(
                f"the space does not go with the journal's trials ({error}): use another journal"
            ) from None
        work = partial(run_trial, job, settings)
        try:
            value = next(spread([work], workers))[1] if cluster else work()
            if isinstance(value, str) or not np.isfinite(value):
                raise FitError(value if isinstance(value, str) else "the score is not a number")
        except _UNFIT as error:
            trial.set_user_attr("error", str(error)[:1000])
            raise
        trial.set_user_attr("by", platform.node())  # refused if others have given the trial up
        return value

    def is_done(study: Any, trial: Any = None) -> bool:
        state = sweep_state(study)
        report(min(1.0, state.finished / trials), f"{state.finished} of {trials} trials")
        if state.finished >= trials:
            if trial:
                study.stop()
            return True
        if len(failed := failures(study)) >= trials:
            raise EstimatorError(
                f"{len(failed)} trials failed and {state.finished} finished; the last failure: "
                f"{failed[-1]}: mend the space and use another journal, or want more trials"
            )
        return False

    with open_study(journal, job.identity, heartbeat_s) as study:
        while not is_done(study):
            # Optuna's refusal of a trial that others gave up, say while this machine slept.
            with suppress(ValueError):
                study.optimize(score, n_jobs=workers.available(), catch=_UNFIT, callbacks=[is_done])
        return sweep_state(study)

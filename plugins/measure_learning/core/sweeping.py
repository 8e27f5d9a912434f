"""Searching an estimator's settings: optuna on a shared journal, or dask workers."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, RootModel, model_validator

from measure.errors import DivergedError, EstimatorError, FitError
from measure.host import Estimator, Registry, Report
from measure.processes import connected, needed
from measure.reading import MAX_TEXT_BYTES, read_bytes
from measure.session import load_toml
from measure_learning.core.files import read_dataset
from measure_learning.core.fitting import fit
from measure_learning.core.scores import corrected_rms_mm
from measure_learning.core.splits import split_by_trajectory

_BEAT_S = 3.0  # between two signs of life of a trial
_SILENT_S = 45.0
"""Without a sign of life for so long a trial is given up: a busy machine delays some."""


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

    finished: int
    failed: int
    running: int
    waiting: int  # to be tried again
    best: tuple[tuple[float, dict[str, Any]], ...]


def read_space(path: Path) -> dict[str, Range]:
    """Read a search space: a TOML table per setting; EstimatorError with its line."""
    return load_toml(path, _Space, EstimatorError).root


def sweep_state(study: Any) -> SweepState:
    """Counts and the ten best trials."""
    import optuna

    states = optuna.trial.TrialState
    counted = (states.COMPLETE, states.FAIL, states.RUNNING, states.WAITING)
    done, failed, running, waiting = (study.get_trials(False, (state,)) for state in counted)
    best = sorted(done, key=lambda t: t.value)[:10]
    return SweepState(
        len(done),
        len(failed),
        len(running),
        len(waiting),
        # A choice is kept as JSON, for a list cannot be one of optuna's.
        tuple(
            (t.value, {k: json.loads(v) if isinstance(v, str) else v for k, v in t.params.items()})
            for t in best
        ),
    )


def open_study(journal: Path, identity: str) -> Any:
    """The study in a journal, started if absent; EstimatorError if it is not this sweep's."""
    optuna = needed("optuna", "sweep", "a sweep", EstimatorError)
    journals = needed("optuna.storages.journal", "sweep", "a sweep", EstimatorError)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal.parent.mkdir(parents=True, exist_ok=True)
    lock = journals.JournalFileOpenLock(str(journal))
    lock.acquire()
    try:
        _check_lines(journal)
    finally:
        lock.release()
    try:
        study = optuna.create_study(
            study_name="sweep",
            storage=optuna.storages.JournalStorage(
                journals.JournalFileBackend(str(journal), lock_obj=lock)
            ),
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(constant_liar=True),
        )
    except (AssertionError, LookupError, TypeError, ValueError) as error:
        raise EstimatorError(f"{journal}: damaged ({error!r}): use another file") from None
    written = study.user_attrs.get("job")
    if written is None:
        study.set_user_attr("job", identity)
    elif written != identity:
        raise EstimatorError(
            f"{journal}: belongs to another sweep, or the data have changed since ({written} then, "
            f"{identity} now): use another file"
        )
    return study


def _check_lines(journal: Path) -> None:
    """Refuse a file that is no journal, or whose last line is torn: optuna would append to it."""
    if not journal.exists():
        return
    content = read_bytes(journal, EstimatorError, MAX_TEXT_BYTES)
    for number, line in enumerate(content.splitlines(keepends=True), 1):
        try:
            good = line.endswith(b"\n") and "op_code" in json.loads(line)
        except (TypeError, ValueError):
            good = False
        if not good:
            raise EstimatorError(
                f"{journal}:{number}: damaged, or not a sweep's journal: use another file"
            )


def ask(study: Any, space: Mapping[str, Range]) -> tuple[Any, dict[str, Any]]:
    """The next trial; EstimatorError if trials had other choices."""
    trial = study.ask()
    try:
        return trial, _suggest(trial, space)
    except ValueError as error:
        raise EstimatorError(
            f"the space does not go with the journal's trials ({error}): use another journal"
        ) from None


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


def finish(study: Any, trial: Any, work: Callable[[], float]) -> None:
    """Do a trial's work and store its score; settings that cannot be fitted fail."""
    try:
        value = work()
    except (DivergedError, FitError, ArithmeticError, ValueError, RuntimeError) as error:
        fail(study, trial, str(error))
        return
    if np.isfinite(value):
        study.tell(trial, value, skip_if_finished=True)  # somebody may have given it up
    else:
        fail(study, trial, "the score is not a number")


def fail(study: Any, trial: Any, reason: str) -> None:
    """Close a trial without a score; it is not tried again."""
    import optuna

    with suppress(RuntimeError):  # somebody has given it up
        trial.set_user_attr("error", reason[:1000])
    study.tell(trial, state=optuna.trial.TrialState.FAIL, skip_if_finished=True)


def failures(study: Any) -> list[str]:
    """Reasons of the failed trials, in order, without those of dead workers."""
    trials = study.get_trials(deepcopy=False)
    return [trial.user_attrs["error"] for trial in trials if "error" in trial.user_attrs]


@contextmanager
def alive(trials: Collection[Any]) -> Iterator[None]:
    """Give signs of life of trials while they are worked on, from a thread beside."""
    over = threading.Event()

    def beat() -> None:
        count = 0
        while not over.wait(_BEAT_S):
            count += 1
            for trial in tuple(trials):
                with suppress(RuntimeError):  # it is finished
                    trial.set_user_attr("beat", count)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def requeue_dead(study: Any, seen: dict[int, tuple[int, float]]) -> None:
    """Queue the settings of trials without signs of life for the next worker.

    `seen` is kept from call to call: the last sign of each trial, and since when, on the clock of
    `time.monotonic`; the machines' own clocks may be set, and differ.
    """
    import optuna

    states, now = optuna.trial.TrialState, time.monotonic()
    for trial in study.get_trials(deepcopy=False, states=(states.RUNNING,)):
        beat = trial.user_attrs.get("beat", 0)
        last, since_s = seen.setdefault(trial.number, (beat, now))
        if beat != last:
            seen[trial.number] = beat, now
        elif now - since_s > _SILENT_S:
            try:
                study.tell(trial.number, state=states.FAIL)
            except (ValueError, RuntimeError):
                continue  # another worker was faster
            study.enqueue_trial(trial.params)


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
    from measure.host.estimator import quiet

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
) -> SweepState:
    """Work on a sweep until it has `trials` finished trials; every process that calls this helps.

    The journal is a file that any number of processes and machines append to, also to say that they
    are alive. The settings of a worker that was killed are tried again by another. The workers of
    a dask cluster run the trials, or without one this process. EstimatorError: an extra is missing,
    the journal is damaged or of another sweep, or as many trials failed as were wanted.
    """
    study, seen = open_study(journal, job.identity), dict[int, tuple[int, float]]()
    while True:
        requeue_dead(study, seen)
        state = sweep_state(study)
        report(min(1.0, state.finished / trials), f"{state.finished} of {trials} trials")
        if state.finished >= trials:
            return state
        if len(failed := failures(study)) >= trials:
            raise EstimatorError(
                f"{len(failed)} trials failed and {state.finished} finished; the last failure: "
                f"{failed[-1]}: mend the space and use another journal, or want more trials"
            )
        if state.finished + state.running >= trials and not state.waiting:
            time.sleep(0.5)
            continue
        if cluster:
            _on_cluster(study, job, space, cluster, trials - state.finished)
        else:
            trial, settings = ask(study, space)
            with alive([trial]):
                finish(study, trial, partial(run_trial, job, settings))


def _on_cluster(
    study: Any, job: SweepJob, space: Mapping[str, Range], cluster: str, wanted: int
) -> None:
    """Hand a batch to dask's workers; dask itself repeats what a dead worker was doing."""
    with connected(cluster, "--cluster") as (client, distributed):
        workers = len(client.scheduler_info()["workers"])
        asked: dict[Any, Any] = {}
        for _ in range(min(wanted, 2 * workers)):
            trial, settings = ask(study, space)
            asked[client.submit(run_trial, job, settings, pure=False)] = trial
        with alive(asked.values()):
            for future in distributed.as_completed(list(asked), loop=client.loop):
                error = future.exception()
                if isinstance(error, distributed.KilledWorker):
                    fail(study, asked[future], f"every worker that tried it died: {error}")
                else:
                    finish(study, asked[future], future.result)

"""Searching an estimator's settings: optuna on a shared journal, or dask workers."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measure.errors import EstimatorError
from measure.host import Registry, Report
from measure.host.cluster import connected
from measure.learning import study as studies
from measure.learning.files import read_dataset
from measure.learning.fitting import fit
from measure.learning.scores import corrected_rms_mm
from measure.learning.splits import split_by_trajectory


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
    """Fit with some settings; RMS in mm on the validation recordings.

    Raises:
        EstimatorError: the data have changed, or the estimator cannot be judged.
        FitError: the estimator fails.
    """
    from measure.host.estimator import quiet

    data = read_dataset(Path(job.data))
    if data.digest() != job.digest:
        raise EstimatorError(f"{job.data}: has changed since the sweep began: use another journal")
    split = split_by_trajectory(data, seed=job.seed)
    registry = Registry.discover()
    estimator = registry.estimator(job.estimator, {**job.settings, **settings})
    estimator.folds = 0  # the score is of corrections, not of covariances
    fit(estimator, split.train, split.validation, seed=job.seed, report=quiet)
    model = getattr(estimator, "model", None)
    if model is None:
        raise EstimatorError(f"estimator '{job.estimator}' cannot be judged: it has no model")
    return corrected_rms_mm(model, split.validation)


def sweep(
    job: SweepJob,
    space: Mapping[str, studies.Range],
    journal: Path,
    trials: int,
    *,
    scheduler: str | None = None,
    report: Report,
) -> studies.SweepState:
    """Work on a sweep until it has `trials` finished trials; every process that calls this helps.

    The journal is a file that any number of processes and machines append to. The settings of a
    worker that was killed are tried again by another: at once on the same machine, elsewhere after
    ten times the longest trial so far, and ten minutes at least.

    Args:
        journal: the sweep's file; started if absent.
        trials: finished trials wanted in all, by all workers.
        scheduler: address of a dask scheduler whose workers run the trials; None runs them here.

    Raises:
        EstimatorError: an extra is missing, the journal is damaged or of another sweep, or as many
            trials failed as were wanted.
    """
    study = studies.open_study(journal, job.identity)
    while True:
        studies.requeue_dead(study)
        state = studies.sweep_state(study)
        report(min(1.0, state.finished / trials), f"{state.finished} of {trials} trials")
        if state.finished >= trials:
            return state
        if len(failed := studies.failures(study)) >= trials:
            raise EstimatorError(
                f"{len(failed)} trials failed and {state.finished} finished; the last failure: "
                f"{failed[-1]}: mend the space and use another journal, or want more trials"
            )
        if state.finished + state.running >= trials and not studies.queued(study):
            time.sleep(0.5)
            continue
        if scheduler:
            _on_cluster(study, job, space, scheduler, trials - state.finished)
        else:
            _one(study, job, space)


def _one(study: Any, job: SweepJob, space: Mapping[str, studies.Range]) -> None:
    trial, settings = studies.ask(study, space)
    studies.finish(study, trial, lambda: run_trial(job, settings))


def _on_cluster(
    study: Any, job: SweepJob, space: Mapping[str, studies.Range], scheduler: str, wanted: int
) -> None:
    """Hand a batch to dask's workers; dask itself repeats what a dead worker was doing."""
    with connected(scheduler, "--scheduler") as (client, distributed):
        workers = len(client.scheduler_info()["workers"])
        asked: dict[Any, Any] = {}
        for _ in range(min(wanted, 2 * workers)):
            trial, settings = studies.ask(study, space)
            asked[client.submit(run_trial, job, settings, pure=False)] = trial
        for future in distributed.as_completed(list(asked), loop=client.loop):
            error = future.exception()
            if isinstance(error, distributed.KilledWorker):
                studies.fail(study, asked[future], f"every worker that tried it died: {error}")
            else:
                studies.finish(study, asked[future], future.result)

"""Measuring many recordings at once, on this machine's cores or on a cluster."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from measure.api.outputs import scratch_folder
from measure.api.run import RunOptions, run
from measure.api.warming_up import warm_pipeline
from measure.errors import ConfigError, MeasureError
from measure.host import Registry
from measure.measuring import Profile
from measure.processes import Progress, connected, processes, quiet, usable_cores
from measure.results import Summary

_ATTEMPTS = 3


@dataclass(frozen=True)
class Outcome:
    """How one recording ended."""

    session: Path
    run: Path
    summary: Summary | None = None  # what was measured; None if it failed
    error: str = ""  # why it failed, in one line; empty if it did not
    defect: str = ""  # the traceback, if the failure is ours and not the user's to mend


@dataclass(frozen=True)
class _RecordingJob:
    """One recording, as it travels to a worker."""

    session: Path
    run: Path
    profile: Profile
    registry: Registry
    options: RunOptions
    started: Path


def run_many(
    sessions: Sequence[Path],
    out: Path,
    profile: Profile,
    registry: Registry,
    options: RunOptions | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress = quiet,
) -> list[Outcome]:
    """Measure recordings independently of each other, each into a folder of its own in `out`.

    Results, one a recording in their order, are those of measuring them one by one. A worker that
    is killed loses no recording: what it was at is measured again from the start. A recording that
    fails does not stop the others.

    Args:
        sessions: their folders; the last part of each path names its run.
        workers: how many processes on this machine; as many as it has cores if omitted.
        cluster: address of a dask scheduler ("tcp://host:8786"), whose workers see the same paths
            and have the plugins installed.
    """
    if workers is not None and workers < 1:
        raise ConfigError(f"--workers {workers}: expected at least 1")
    names = [Path(session).resolve().name for session in sessions]
    if doubles := [name for name, count in Counter(names).items() if count > 1]:
        raise ConfigError(
            f"two recordings are called '{doubles[0]}', and so would their runs in {out}: "
            "measure them separately, or rename a folder"
        )
    with _scratch(out) as scratch:
        jobs = [
            _RecordingJob(
                Path(session).resolve(),
                out.resolve() / name,
                profile,
                registry,
                options or RunOptions(),
                started=scratch / name,
            )
            for session, name in zip(sessions, names, strict=True)
        ]
        finished = _on_cluster(jobs, cluster) if cluster else _on_this_machine(jobs, workers)
        outcomes: dict[Path, Outcome] = {}
        for outcome in finished:
            outcomes[outcome.session] = outcome
            progress(len(outcomes), len(jobs))
        return [outcomes[job.session] for job in jobs]


@contextmanager
def _scratch(out: Path) -> Iterator[Path]:
    """A folder with a file for each recording that this batch has begun."""
    with ExitStack() as stack:
        try:
            out.mkdir(parents=True, exist_ok=True)
            folder = stack.enter_context(scratch_folder(out.resolve(), ".begun-"))
        except OSError as error:
            why = f"cannot make a folder there ({error.strerror})"
            raise ConfigError(f"--out {out}: {why}") from error
        yield folder


def _measure(job: _RecordingJob) -> Outcome:
    """Measure one recording; runs in a worker, maybe for the second time."""
    import cv2

    cv2.setNumThreads(1)
    options = job.options
    if job.started.exists() and not options.resume:
        # An earlier attempt of this batch was killed here.
        options = replace(options, overwrite=True)
    job.started.touch()
    try:
        summary = run(job.session, job.run, job.profile, job.registry, options)
    except MeasureError as error:
        return Outcome(job.session, job.run, error=str(error))
    except Exception as error:
        line = f"a defect of the program: {type(error).__name__}: {error}"
        return Outcome(job.session, job.run, error=line, defect=traceback.format_exc())
    return Outcome(job.session, job.run, summary)


def _on_this_machine(jobs: Sequence[_RecordingJob], workers: int | None) -> Iterator[Outcome]:
    """By processes; after a process was killed, the rest goes on in new ones."""
    _compile_once(jobs)
    left = list(jobs)
    for attempt in range(_ATTEMPTS):
        if not left:
            return
        # The last time each recording has a process of its own: one that kills it (memory) must not
        # take the others along.
        batches = [[job] for job in left] if attempt == _ATTEMPTS - 1 else [left]
        left = []
        for batch in batches:
            for job, outcome in _in_processes(batch, workers):
                if outcome is None:
                    left.append(job)
                else:
                    yield outcome
    for job in left:
        yield Outcome(
            job.session,
            job.run,
            error=f"its process was killed {_ATTEMPTS} times (out of memory?): try --workers 1",
        )


def _compile_once(jobs: Sequence[_RecordingJob]) -> None:
    """Compile the hot loops before the processes start; failures are reported by the jobs."""
    for job in jobs:
        with suppress(MeasureError), job.options.open(job.session) as session:
            warm_pipeline(job.profile, job.registry, session.body, session.cameras)
            return


def _in_processes(
    jobs: Sequence[_RecordingJob], workers: int | None
) -> Iterator[tuple[_RecordingJob, Outcome | None]]:
    """Each job with its outcome, or None if its process was killed."""
    count = max(1, min(workers or usable_cores(), len(jobs)))
    with processes(count) as pool:
        waiting: dict[Future[Outcome], _RecordingJob] = {
            pool.submit(_measure, job): job for job in jobs
        }
        for future in as_completed(waiting):
            try:
                yield waiting[future], future.result()
            except BrokenProcessPool:
                yield waiting[future], None


def _on_cluster(jobs: Sequence[_RecordingJob], address: str) -> Iterator[Outcome]:
    """By a dask scheduler, which gives a lost worker's task to another one."""
    with connected(address, "--cluster") as (client, distributed):
        waiting = {client.submit(_measure, job, pure=False): job for job in jobs}
        for future in distributed.as_completed(list(waiting), loop=client.loop):
            job = waiting[future]
            error = future.exception()
            if error is None:
                yield future.result()
            else:
                line = f"the cluster gave it up: {type(error).__name__}: {error}"
                yield Outcome(job.session, job.run, error=" ".join(line.split()))

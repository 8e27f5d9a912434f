"""Measuring many recordings at once, on this machine's cores or on a cluster."""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from measure.api.outputs import scratch_folder
from measure.api.run import RunOptions, run
from measure.api.spreading import ALL_CORES, Workers, spread
from measure.api.warming_up import warm_pipeline
from measure.errors import ConfigError, MeasureError
from measure.host import Registry
from measure.measuring import Profile
from measure.processes import Progress, quiet
from measure.results import Summary


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
    workers: Workers = ALL_CORES,
    progress: Progress = quiet,
) -> list[Outcome]:
    """Measure recordings independently of each other, each into a folder of its own in `out`.

    Results, one per recording in their order, are those of measuring them one by one. A worker that
    is killed loses no recording: what it was at is measured again from the start. A recording that
    fails does not stop the others.

    Args:
        sessions: their folders; the last part of each path names its run.
    """
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
        if not workers.cluster:
            _compile_once(jobs)
        outcomes: dict[int, Outcome] = {}
        for number, ended in spread([partial(_measure, job) for job in jobs], workers):
            if isinstance(ended, str):
                ended = Outcome(jobs[number].session, jobs[number].run, error=ended)
            outcomes[number] = ended
            progress(len(outcomes), len(jobs))
        return [outcomes[number] for number in range(len(jobs))]


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


def _compile_once(jobs: Sequence[_RecordingJob]) -> None:
    """Compile the hot loops before the processes start; failures are reported by the jobs."""
    for job in jobs:
        with suppress(MeasureError), job.options.open(job.session) as session:
            warm_pipeline(job.profile, job.registry, session.body, session.cameras)
            return

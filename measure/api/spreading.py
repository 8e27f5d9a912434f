"""Work spread over processes of this machine or the workers of a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

from measure.errors import ConfigError, MeasureError
from measure.processes import connected, processes, usable_cores

R = TypeVar("R")
_ATTEMPTS = 3


@dataclass(frozen=True)
class Workers:
    """Who does work side by side.

    Attributes:
        workers: how many processes measure several sessions side by side, as many as there are
            cores if omitted; or stretches of a long one, which this process measures if omitted.
        cluster: a dask scheduler's address, tcp://HOST:PORT, whose workers do so instead. They see
            the same paths, and have the plugins installed.
    """

    workers: int | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ConfigError(f"--workers {self.workers}: expected at least 1")

    def available(self) -> int:
        """How many there are."""
        if not self.cluster:
            return self.workers or usable_cores()
        with connected(self.cluster, "--cluster") as (client, _):
            return len(client.scheduler_info(n_workers=-1)["workers"])


ALL_CORES = Workers()


def spread(jobs: Sequence[Callable[[], R]], workers: Workers) -> Iterator[tuple[int, R | str]]:
    """Do jobs side by side; yields the number of each, as it ends, with what it returned.

    A job whose worker is killed is begun again in another one; instead of what a job returned there
    is a line that says why, when it was lost for good. What the user can mend is raised.

    Args:
        jobs: they are pickled.
    """
    if workers.cluster:
        return _on_cluster(jobs, workers.cluster)
    return _on_this_machine(jobs, workers.available())


def _on_this_machine(jobs: Sequence[Callable[[], R]], count: int) -> Iterator[tuple[int, R | str]]:
    """By processes; after a process was killed, the rest goes on in new ones."""
    left = dict(enumerate(jobs))
    for attempt in range(_ATTEMPTS):
        # The last time each job has a process of its own: one that kills it (memory) must not take
        # the others along.
        alone = attempt == _ATTEMPTS - 1
        for batch in [{number: left[number]} for number in left] if alone else [dict(left)]:
            for number, result in _in_processes(batch, count):
                del left[number]
                yield number, result
    for number in left:
        yield number, f"its process was killed {_ATTEMPTS} times (out of memory?): try --workers 1"


def _in_processes(jobs: Mapping[int, Callable[[], R]], count: int) -> Iterator[tuple[int, R]]:
    """Each job with what it returned, but for those whose process was killed."""
    if not jobs:
        return
    with processes(min(count, len(jobs))) as pool:
        waiting: dict[Future[R], int] = {
            pool.submit(_on_one_core, job): number for number, job in jobs.items()
        }
        for future in as_completed(waiting):
            try:
                result = future.result()
            except BrokenProcessPool:
                continue
            yield waiting.pop(future), result


def _on_cluster(jobs: Sequence[Callable[[], R]], address: str) -> Iterator[tuple[int, R | str]]:
    """By a dask scheduler, which gives a lost worker's task to another one."""
    with connected(address, "--cluster") as (client, distributed):
        waiting = {
            client.submit(_on_one_core, job, pure=False): number for number, job in enumerate(jobs)
        }
        for future in distributed.as_completed(list(waiting), loop=client.loop):
            error = future.exception()
            if error is None or isinstance(error, MeasureError):
                yield waiting.pop(future), future.result()  # raises it, as on this machine
            else:
                line = f"the cluster gave it up: {type(error).__name__}: {error}"
                yield waiting.pop(future), " ".join(line.split())


def _on_one_core(job: Callable[[], R]) -> R:
    """Do a job in a worker: the others have the other cores."""
    import cv2

    cv2.setNumThreads(1)
    return job()

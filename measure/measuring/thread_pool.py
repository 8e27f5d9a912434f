"""Work on the cameras of a frame set, distributed over the machine's cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self, TypeVar

from measure.processes import usable_cores

R = TypeVar("R")


class CameraPool:
    """As many threads as cores, the caller's own among them; each takes the next camera when free.

    Submitting work to a thread and waiting for it costs as much as tracking a ball or two, so the
    caller works as well, and alone on a single core.
    """

    def __init__(self, max_threads: int, cores: int | None = None) -> None:
        """At most `max_threads`; on `cores` cores, those this process may use if omitted."""
        self._helpers = min(max_threads, cores or usable_cores()) - 1
        self._pool = ThreadPoolExecutor(max(self._helpers, 1))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._pool.shutdown()

    def map(self, work: Callable[[str], R], names: Iterable[str]) -> dict[str, R]:
        """The result of `work` for every name, in the order of the names."""
        names = list(names)
        waiting = iter(names)

        def share() -> dict[str, R]:
            return {name: work(name) for name in waiting}

        helpers = [self._pool.submit(share) for _ in range(min(self._helpers, len(names) - 1))]
        done = share()
        for helper in helpers:
            done.update(helper.result())
        return {name: done[name] for name in names}

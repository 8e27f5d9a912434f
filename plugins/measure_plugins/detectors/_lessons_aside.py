"""Lessons that are taken while pictures go on being measured."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from measure_plugins._edges.appearance import Appearance


class LessonsAside:
    """Takes a lesson at a time in a thread of its own."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="lesson")
        self._lesson: Future[Appearance] | None = None

    def begin(self, lesson: Callable[[], Appearance]) -> None:
        """Begin a lesson; while one is taken, others are left out."""
        if self._lesson is None:
            self._lesson = self._pool.submit(lesson)

    def done(self) -> Appearance | None:
        """What has been learnt, once; None as long as there is nothing."""
        if self._lesson is None or not self._lesson.done():
            return None
        lesson, self._lesson = self._lesson, None
        return lesson.result()

"""Checkpoints of a fit, from which it can be resumed."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from measure.errors import EstimatorError
from measure.reading import check_ordinary

T = TypeVar("T")

EVERY_S = 10.0  # between two writes
_SHOWN = 100  # characters of a reason


class Checkpoint:
    """One net's training state in a folder; without a folder it does nothing.

    A file of other data, another seed or other settings (`key`) is ignored.
    """

    def __init__(self, folder: Path | None, name: str, key: Any) -> None:
        self._path = folder / f"{name}.pt" if folder else None
        self._key = repr(key)
        self._stored_s = time.monotonic()

    def load(self, restore: Callable[[dict[str, Any]], T]) -> T | None:
        """What `restore` makes of the last stored state, if that belongs to this fit.

        Raises:
            EstimatorError: it is damaged, or holds other things than tensors and plain values,
                which may be code and are not even built.
        """
        import torch

        if self._path is None or not self._path.exists():
            return None
        check_ordinary(self._path, EstimatorError)
        try:
            found: dict[str, Any] = torch.load(self._path, weights_only=True)
            return restore(found) if found.pop("key", None) == self._key else None
        except Exception as error:  # torch raises many kinds; all mean the file
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise EstimatorError(
                f"{self._path}: damaged ({reason[:_SHOWN]}): train again without --resume"
            ) from None

    def store(self, *, now: bool = False, **state: Any) -> None:
        """Write the state, at most every few seconds unless it has to be `now`.

        It holds tensors, numbers, texts, lists, tuples and dictionaries: `load` takes no more.
        """
        import torch

        if self._path is None or not (now or time.monotonic() - self._stored_s > EVERY_S):
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self._path.with_suffix(".new")
        torch.save(state | {"key": self._key}, fresh)
        fresh.replace(self._path)
        self._stored_s = time.monotonic()

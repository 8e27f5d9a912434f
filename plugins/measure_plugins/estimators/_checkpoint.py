"""Checkpoints of a fit, from which it can be resumed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from measure.errors import EstimatorError

EVERY_S = 10.0  # between two writes


class Checkpoint:
    """One net's training state in a folder; without a folder it does nothing.

    A file of other data, another seed or other settings (`key`) is ignored.
    """

    def __init__(self, folder: Path | None, name: str, key: Any) -> None:
        self._path = folder / f"{name}.pt" if folder else None
        self._key = repr(key)
        self._stored_s = time.monotonic()

    def load(self) -> dict[str, Any] | None:
        """The last stored state, if it belongs to this fit.

        Raises:
            EstimatorError: it is damaged.
        """
        import torch

        if self._path is None or not self._path.exists():
            return None
        try:
            found: dict[str, Any] = torch.load(self._path, weights_only=False)
        except Exception as error:  # torch raises many kinds; all mean the file
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise EstimatorError(
                f"{self._path}: damaged ({reason}): train again without --resume"
            ) from None
        return found if found.pop("key", None) == self._key else None

    def store(self, *, now: bool = False, **state: Any) -> None:
        """Write the state, at most every few seconds unless it has to be `now`."""
        import torch

        if self._path is None or not (now or time.monotonic() - self._stored_s > EVERY_S):
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self._path.with_suffix(".new")
        torch.save(state | {"key": self._key}, fresh)
        fresh.replace(self._path)
        self._stored_s = time.monotonic()

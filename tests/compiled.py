"""What has been compiled, and when."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def nothing_compiles(*loops: Any) -> Iterator[None]:
    """All loops are compiled already, for the very types that are used in the block."""
    before = [len(loop.signatures) for loop in loops]
    assert min(before) > 0
    yield
    assert [len(loop.signatures) for loop in loops] == before

"""Examples in docstrings give what they say."""

from __future__ import annotations

import doctest
import importlib

import pytest

from tests.docs.pages import ROOT


def _modules_with_examples() -> list[str]:
    found = []
    for root in (ROOT, ROOT / "plugins"):
        for package in ("measure", "measure_plugins"):
            for path in sorted((root / package).rglob("*.py")):
                if ">>> " in path.read_text(encoding="utf-8"):
                    parts = path.relative_to(root).with_suffix("").parts
                    found.append(".".join(parts).removesuffix(".__init__"))
    return found


@pytest.mark.parametrize("module", _modules_with_examples())
def test_docstrings(module: str):
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted
    assert not result.failed

"""Reference pages say what the program says of itself."""

from __future__ import annotations

import importlib.util
import inspect
import pkgutil
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from types import ModuleType

import pytest

import measure
from measure.checking.causes import Word
from measure.host import Registry, SelfCalibratingDetector, describe_settings, hooks
from measure.model.doubts import sentences
from measure.neighbours import commands
from measure.results.tables import CSV_COLUMNS, SCHEMAS
from tests.docs.pages import ROOT

PLUGIN_PAGE = (ROOT / "docs" / "writing_a_plugin.md").read_text(encoding="utf-8")
ALLOWED_IMPORTS = PLUGIN_PAGE.partition("A plugin may import")[2].partition("\n\n")[0]
OUTSIDE = (
    *("builtins", "typing", "collections.abc", "numpy.typing", "pathlib"),
    *("measure.arrays", "measure.errors"),
)
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
    "contracts"
]


@pytest.fixture(scope="module")
def generator() -> Iterator[ModuleType]:
    """`docs/generated_pages.py`; it imports from its own folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        yield _load()


def _load() -> ModuleType:
    path = ROOT / "docs" / "generated_pages.py"
    spec = importlib.util.spec_from_file_location("generated_pages", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_command_line_page_describes_every_command(generator: ModuleType):
    page = generator.command_line_page()
    assert set(re.findall(r"^## measure ([\w-]+)$", page, re.MULTILINE)) == set(commands())
    assert re.search(r"^- `--body.*`: \w", page, re.MULTILINE)


def test_the_settings_page_names_every_setting(generator: ModuleType):
    page = generator.settings_page()
    own = [p for p in Registry.discover().loaded if p.distribution.name == "triball"]
    assert {p.name for p in own} == set(re.findall(r"^\| \*\*([\w-]+)\*\*", page, re.MULTILINE))
    settings = {s.name for p in own for s in describe_settings(p.plugin.Config)}
    assert sorted(name for name in settings if f"\n| `{name}` |" not in page) == []


def test_the_page_of_findings_has_a_row_for_every_doubt(generator: ModuleType):
    rows = re.findall(
        r"^\| `([\w-]+)` \| \S.* \| \S.* \| \S.* \|$", generator.findings_page(), re.M
    )
    assert rows == list(sentences())
    causes = (ROOT / "docs" / "explanation" / "what_can_go_wrong.md").read_text(encoding="utf-8")
    assert sorted(word for word in Word if f"\n| `{word}` |" not in causes) == []


def test_all_that_a_plugin_may_use_is_described(generator: ModuleType):
    """Every class, function, method and constant has a docstring, every field its line in it."""
    assert sys.modules["plugin_reference"].undocumented() == []


def test_types_in_signatures_are_described_too(generator: ModuleType):
    page = generator.plugin_page()
    signatures = " ".join(re.findall(r"`([^`]*)`", page))
    named = set(re.findall(r"(?<![\w.])[A-Z][a-z]\w*", signatures))
    described = set(re.findall(r"^(?:### |- `)([A-Z]\w*)", page, re.MULTILINE))
    outside = {name for module in OUTSIDE for name in dir(importlib.import_module(module))}
    outside |= {"BaseModel", "Config", "StrEnum", "ColorSpace", "StateSchema", "Scene"}
    outside |= {"Command", "Format"}  # of what is declared as data
    assert sorted(named - described - outside) == []


def test_every_built_in_setting_has_a_description(generator: ModuleType):
    own = [p for p in Registry.discover().loaded if p.distribution.name == "triball"]
    described = {p.name: describe_settings(p.plugin.Config) for p in own}
    bare = [f"{name}.{s.name}" for name, found in described.items() for s in found
            if not s.description]  # fmt: skip
    assert sum(map(len, described.values())) > 40
    assert bare == []


def test_every_column_of_a_run_is_documented():
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    columns = {field.name for schema in SCHEMAS.values() for field in schema} | set(CSV_COLUMNS)
    assert sorted(name for name in columns if f"`{name}`" not in page) == []


@pytest.mark.parametrize("kind", hooks.KINDS, ids=lambda kind: kind.name)
def test_every_hook_is_documented_with_its_exact_signature(kind: hooks.Kind):
    hook = getattr(hooks, kind.hook)
    assert f"\n### {kind.hook}{_signature(hook)}\n" in PLUGIN_PAGE
    assert f"\n{inspect.getdoc(hook)}\n" in PLUGIN_PAGE


def _signature(function: Callable[..., object]) -> str:
    """As written in the source: annotations are text there."""
    return str(inspect.signature(function)).replace("'", "")


def _methods() -> list[tuple[str, str]]:
    """Every abstract method and constructor a plugin author meets."""
    return [
        (kind.interface.__name__, method)
        for kind in hooks.KINDS
        for method in ("__init__", *sorted(kind.interface.__abstractmethods__))
    ]


@pytest.mark.parametrize(("interface", "method"), _methods())
def test_every_method_is_documented_with_its_exact_signature(interface: str, method: str):
    (owner,) = (k.interface for k in hooks.KINDS if k.interface.__name__ == interface)
    signature = _signature(getattr(owner, method))
    assert f"\n`{interface}.{method}{signature}`\n" in PLUGIN_PAGE


def test_no_hook_is_documented_that_does_not_exist():
    documented = {line[4:].partition("(")[0] for line in PLUGIN_PAGE.splitlines() if "###" in line}
    assert documented == {kind.hook for kind in hooks.KINDS}


def test_optional_members_are_documented_with_their_signatures():
    for member, value in vars(SelfCalibratingDetector).items():
        if getattr(value, "__isabstractmethod__", False):
            signature = "" if isinstance(value, property) else _signature(value)
            assert f"\n`SelfCalibratingDetector.{member}{signature}`" in PLUGIN_PAGE
    for flag in ("stateful", "provides_outlines", "requires_outlines"):
        assert f"`{flag} = " in PLUGIN_PAGE


def test_the_architecture_page_names_every_package():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = {f"measure.{module.name}" for module in pkgutil.iter_modules(measure.__path__)}
    assert sorted(r for r in rooms if f"`{r}`" not in page) == ["measure.__main__"]


def test_plugins_import_what_the_page_allows_and_no_more():
    """The contract that the neighbours keep forbids every other room of the house."""
    allowed = set(re.findall(r"`(measure\.\w+)`", ALLOWED_IMPORTS))
    rooms = {f"measure.{module.name}" for module in pkgutil.iter_modules(measure.__path__)}
    (contract,) = [c for c in CONTRACTS if c["name"].startswith("Neighbours use what")]
    assert allowed <= rooms
    assert allowed | set(contract["forbidden_modules"]) == rooms

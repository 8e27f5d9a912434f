"""The host knows no built-in: it runs without them, and its sources do not name them."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import measure
from measure.host import Registry, hooks

SOURCES = Path(measure.__file__).parent
BUILT_IN_MODULES = {
    entry.value for entry in metadata.entry_points(group=hooks.ENTRY_POINT_GROUP)
    if entry.dist is not None and entry.dist.name == "triball"
}  # fmt: skip


def _strings(source: str) -> set[str]:
    """Every string constant of a module that is not a docstring."""
    tree = ast.parse(source)
    prose = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in prose
    }


def test_built_ins_come_by_entry_point_like_anybody():
    own = [item for item in Registry.discover().loaded if item.distribution.name == "triball"]
    modules = {item.plugin.__module__ for item in own}
    assert [m for m in modules if not any(m.startswith(known) for known in BUILT_IN_MODULES)] == []
    assert Registry.discover().broken == []
    assert Registry.discover().clashes() == []


NEIGHBOURS = sorted({m.partition(".")[0] for m in BUILT_IN_MODULES} - {"measure"})


def test_no_source_of_the_program_imports_a_neighbour():
    assert "measure_plugins" in NEIGHBOURS
    for path in SOURCES.rglob("*.py"):
        for name in NEIGHBOURS:
            assert f"import {name}" not in path.read_text(), path
            assert f"from {name}" not in path.read_text(), path


def test_the_host_names_no_built_in():
    loaded = Registry.discover().loaded
    names = {item.name for item in loaded if not item.plugin.__module__.startswith("measure.")}
    for path in (SOURCES / "host").rglob("*.py"):
        assert not _strings(path.read_text()) & names, path


def test_the_host_runs_with_the_built_ins_blocked():
    """Also where the package of built-ins cannot be imported at all."""
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({NEIGHBOURS}));"
        "from measure.host import Registry; r = Registry.discover();"
        "print(len(r.loaded), {b.distribution.name for b in r.broken} or 'none broken');"
        "import measure.measuring, measure.session, measure.simulation, measure.results;"
        "r = Registry.discover(disabled=['triball']); print(len(r.loaded), len(r.broken));"
        "from measure.cli import main; sys.exit(main(['plugins', 'list', '--disable', 'triball']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "2 {'triball'}", "trackers of the house"
    assert lines[1] == "0 0"

"""Every block in the documentation is run, read or compared; none is only decoration."""

from __future__ import annotations

import contextlib
import doctest
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from measure.cli import main
from measure.neighbours import commands
from tests.docs.pages import PAGES, ROOT, Block, blocks, name_of

LANGUAGES = {"bash", "toml", "python", "pycon", "text", "cpp", "cmake"}
DEMO = "measure demo --out triball-demo"
ELSEWHERE = ("demo-command", "test-command")
"""Blocks with these marks are whole installations: `.ci/run` runs them."""
COMMANDS = set(commands())

pytestmark = pytest.mark.timeout(900)
"""The first page's commands compile everything on a machine that has just been set up."""

by_page = pytest.mark.parametrize("page", PAGES, ids=name_of)


@by_page
def test_every_block_is_of_a_kind_that_is_checked(page: Path):
    for block in blocks(page):
        assert block.language in LANGUAGES, f"line {block.line}: ```{block.language}"
    assert page.read_text(encoding="utf-8").count("\n```") == 2 * len(blocks(page))


@by_page
def test_examples_give_what_they_say(page: Path):
    text = "\n".join(block.text for block in blocks(page) if _example(block))
    test = doctest.DocTestParser().get_doctest(text, {}, name_of(page), str(page), 0)
    report: list[str] = []
    failed = doctest.DocTestRunner(verbose=False).run(test, out=report.append).failed
    assert not failed, "".join(report)


@by_page
def test_toml_is_toml(page: Path):
    for block in blocks(page):
        if block.language == "toml" and not block.listing:
            tomllib.loads(block.text)


@by_page
def test_files_that_the_site_lists_exist(page: Path):
    listed = [block.listing for block in blocks(page) if block.listing]
    assert [name for name in listed if not (ROOT / name).is_file()] == []


@by_page
def test_links_lead_somewhere(page: Path):
    hook = (ROOT / "docs" / "generated_pages.py").read_text(encoding="utf-8")
    made = [ROOT / "docs" / name for name in re.findall(r'^ +"([\w/]+\.md)":', hook, re.M)]
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            there = (page.parent / target).resolve()
            assert there.exists() or there in made, target


@by_page
def test_files_that_are_named_exist(page: Path):
    named = re.findall(r"`((?:tests|benchmarks|measure|plugins)/[\w/.]+)`", page.read_text("utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


@by_page
def test_commands_that_are_only_shown_exist(page: Path):
    """In text blocks and in running text."""
    text = page.read_text(encoding="utf-8")
    listed = [line for b in blocks(page) if b.language == "text" for line in b.text.splitlines()]
    shown = [line.split()[1] for line in listed if re.match(r"measure \w", line)]
    shown += re.findall(r"`measure (\w+)", text)
    assert set(shown) <= COMMANDS | {"COMMAND"}, set(shown) - COMMANDS


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the tutorial's first command makes, with fewer frame sets."""
    folder = tmp_path_factory.mktemp("docs")
    with contextlib.chdir(folder):
        _run(f"{DEMO} --frames 5")
    return folder / "triball-demo"


def _example(block: Block) -> bool:
    return block.language in ("python", "pycon") and block.text.startswith(">>> ")


def _runnable(block: Block) -> bool:
    return (
        block.language in ("bash", "python")
        and not _example(block)
        and not block.marked("skip")
        and not block.listing
        and block.mark not in ELSEWHERE
        and block.page.name != "CONTRIBUTING.md"  # the test suite cannot run itself
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if any(map(_runnable, blocks(page)))], ids=name_of
)
def test_a_page_can_be_followed(page: Path, demo: Path, tmp_path: Path):
    """Its files are written and its commands run, in order, in an empty folder with the demo."""
    (tmp_path / "triball-demo").symlink_to(demo)
    (tmp_path / "calibration_targets").symlink_to(ROOT / "calibration_targets")
    with contextlib.chdir(tmp_path):
        for block in blocks(page):
            if file := block.marked("file"):
                Path(file).parent.mkdir(parents=True, exist_ok=True)
                Path(file).write_text(block.text, encoding="utf-8")
            elif _runnable(block) and block.language == "python":
                exec(compile(block.text, f"{page}:{block.line}", "exec"), {"__name__": "__main__"})
            elif _runnable(block):
                for line in block.text.replace("\\\n", " ").splitlines():
                    if line.split("#")[0].strip() not in ("", DEMO):
                        _run(line)


def _run(line: str) -> None:
    """In this process: loading and compiling everything anew costs more than most commands do."""
    words = shlex.split(line, comments=True)
    assert words[0] == "measure", f"only `measure` is run here; mark the block to skip: {line}"
    assert main(words[1:]) == 0, line

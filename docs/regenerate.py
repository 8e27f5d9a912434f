"""Write what is generated in the docs: `python docs/regenerate.py`.

`docs/cli.md` holds the help of every command; blocks marked `<!-- same as: FILE -->` hold a file of
the repository. The tests compare.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from pathlib import Path

from measure.cli import build_app, main
from measure.cli.commands import GROUPS

ROOT = Path(__file__).resolve().parents[1]
HEAD = """# Command line

The help of every command. Written by `python docs/regenerate.py`.

Exit codes: 0 done; 2 a mistake, which one line on stderr explains; 1 a defect of ours, with its
traceback; 130 interrupted; 141 whoever read the output went away.
"""
SAME = re.compile(r"<!-- same as: (\S+) -->\n```(\w+)\n(.*?)```\n", re.DOTALL)


def command_line_page() -> str:
    """The text of `docs/cli.md`."""
    app = build_app()
    names = [c.name for commands in GROUPS.values() for c in commands if c.name in app]
    pages = [((), "measure")]
    for name in names:
        pages.append(((name,), f"measure {name}"))
        subcommands = [sub for sub in app[name] if not sub.startswith("-")]
        pages += [((name, sub), f"measure {name} {sub}") for sub in subcommands]
    return HEAD + "".join(f"\n## {title}\n\n```text\n{help_of(*t)}```\n" for t, title in pages)


def help_of(*tokens: str) -> str:
    """A command's help as an 80-column terminal shows it, without trailing spaces."""
    out = io.StringIO()
    before = dict(os.environ)
    os.environ.update(COLUMNS="80", TERM="dumb", NO_COLOR="1")
    try:
        with contextlib.redirect_stdout(out):
            main([*tokens, "--help"])
    finally:
        os.environ.clear()
        os.environ.update(before)
    return "".join(f"{line.rstrip()}\n" for line in out.getvalue().strip().splitlines())


def with_files(text: str) -> str:
    """A page with the current text of every file it shows."""

    def show(match: re.Match[str]) -> str:
        content = (ROOT / match[1]).read_text(encoding="utf-8")
        return f"<!-- same as: {match[1]} -->\n```{match[2]}\n{content}```\n"

    return SAME.sub(show, text)


if __name__ == "__main__":
    (ROOT / "docs" / "cli.md").write_text(command_line_page(), encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        page.write_text(with_files(page.read_text(encoding="utf-8")), encoding="utf-8")

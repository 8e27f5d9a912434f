"""Write what is generated in the docs: `python docs/regenerate.py`.

`docs/cli.md` holds the help of every command, `docs/settings.md` every setting of the built-in
plugins and profiles, `docs/reference/plugins.md` what a plugin may use; blocks marked
`<!-- same as: FILE -->` hold a file of the repository. The tests compare.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import re
from pathlib import Path

from plugin_reference import attributes, plugin_page

from measure.api.profiles import load_profile, profile_names
from measure.cli import build_app, main
from measure.host import Loaded, Registry, Setting, describe_settings
from measure.measuring import Profile
from measure.neighbours import commands

ROOT = Path(__file__).resolve().parents[1]
HEAD = """# Command line

The help of every command; where `measure` is not on the path, `python -m measure` is the same.
Written by `python docs/regenerate.py`.

Exit codes: 0 done; 2 a mistake, which one line on stderr explains; 3 `check`,
`calibrate` or `accept` found what must not be believed ("wrong"); 1 a defect of ours, with its
traceback; 130 interrupted; 143 ended by SIGTERM; 141 whoever read the output went away.

`--out`, `--overwrite`: [one rule for all outputs](conventions.md#outputs).
"""
SETTINGS_HEAD = """# Settings

Every setting of the stages that come with the program. Written by `python docs/regenerate.py` from
the code that checks them; `measure plugins show NAME` prints the same of any plugin, also of
others'.

A stage is chosen with `--detector`, `--triangulator` or `--solver`, a setting changed with `--set`:

```text
measure run SESSION --out RUN --set detector.rays=128 --set tracking.lost_after=5
```

or both in a profile, a TOML file given with `--profile`. The `run.toml` of a run serves as one,
too. A sink is chosen with `--send`; its settings follow a `?` in the address, or are
given as `--set SINK.NAME=VALUE` ([sending poses](how_to/send_poses.md)).
"""
KINDS = {
    "detector": "Detectors",
    "triangulator": "Triangulators",
    "solver": "Pose solvers",
    "tracker": "Trackers",
    "estimator": "Estimators",
    "sink": "Sinks",
}
SAME = re.compile(r"<!-- same as: (\S+) -->\n```(\w+)\n(.*?)```\n", re.DOTALL)


def command_line_page() -> str:
    """The text of `docs/cli.md`."""
    app = build_app()
    names = [name for name in commands() if name in app]
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


def settings_page() -> str:
    """The text of `docs/settings.md`."""
    parts = [SETTINGS_HEAD, profiles_section()]
    own = [p for p in Registry.discover().loaded if p.distribution.name == "triball"]
    for kind, title in KINDS.items():
        parts.append(f"\n## {title}\n")
        parts += [plugin_section(p) for p in sorted(own, key=lambda p: p.name) if p.kind == kind]
    return "".join(parts)


def profiles_section() -> str:
    """What each profile chooses, and what the entries mean."""
    profiles = {name: load_profile(name) for name in profile_names()}
    entries = [name for name in Profile.model_fields if name != "name"]
    meanings = attributes(Profile)
    head = ["entry", *(f"`{name}`" for name in profiles), "what it is"]
    rows = [
        [f"`{entry}`", *(f"`{getattr(p, entry)!r}`" for p in profiles.values()), meanings[entry]]
        for entry in entries
    ]
    return "\n## Profiles\n\n" + table(head, rows)


def plugin_section(item: Loaded) -> str:
    """One plugin: what it does, and its settings."""
    return section(item.name, item.plugin, describe_settings(item.plugin.Config))


def section(name: str, described: type, settings: list[Setting]) -> str:
    """A heading, the first sentence of the docstring, and a table."""
    words = (inspect.getdoc(described) or "").partition("\n\n")[0]
    rows = [
        [f"`{s.name}`", f"`{s.default}`", s.unit, f"`{s.type}`".replace("|", "or"), s.description]
        for s in settings
    ]
    head = ["setting", "default", "unit", "type", "what it does"]
    body = table(head, rows) if rows else "It has no settings.\n"
    return f"\n### {name}\n\n{' '.join(words.split())}\n\n{body}"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def with_files(text: str) -> str:
    """A page with the current text of every file it shows."""

    def show(match: re.Match[str]) -> str:
        content = (ROOT / match[1]).read_text(encoding="utf-8")
        return f"<!-- same as: {match[1]} -->\n```{match[2]}\n{content}```\n"

    return SAME.sub(show, text)


if __name__ == "__main__":
    (ROOT / "docs" / "cli.md").write_text(command_line_page(), encoding="utf-8")
    (ROOT / "docs" / "settings.md").write_text(settings_page(), encoding="utf-8")
    (ROOT / "docs" / "reference" / "plugins.md").write_text(plugin_page(), encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        page.write_text(with_files(page.read_text(encoding="utf-8")), encoding="utf-8")

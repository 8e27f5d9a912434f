"""Pages that MkDocs makes from the program when it builds the site (`hooks` in mkdocs.yml).

`cli.md` holds the help of every command, `settings.md` every setting of the built-in plugins and
profiles, `reference/findings.md` the codes of findings, and
`reference/plugins.md` what a plugin may use.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import os
import re
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from plugin_reference import attributes, plugin_page

from measure.api.profiles import load_profile, profile_names
from measure.cli import build_app, main
from measure.host import Loaded, Registry, Setting, describe_settings
from measure.measuring import Profile
from measure.model.doubts import sentences
from measure.neighbours import commands

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

HEAD = """# Command line

The `--help` of every command. Where `measure` is not on the path, type `python -m measure` instead.

| exit code | meaning |
|---:|---|
| 0 | done |
| 1 | a defect of the program, with its traceback |
| 2 | a mistake; one line on stderr explains it |
| 3 | `check`, `calibrate` or `accept` found something wrong; do not rely on the result |
| 130, 143 | interrupted, ended by SIGTERM |
| 141 | the reader of the output closed it |

`--out`, `--overwrite`: [one rule for all outputs](conventions.md#outputs).
"""
SETTINGS_HEAD = """# Settings

Every setting of the built-in stages. `measure plugins show NAME` prints those of any installed
plugin.

`--detector`, `--triangulator` and `--solver` choose a stage. `--set` changes a setting:

```text
measure run SESSION --out RUN --set detector.rays=128 --set tracking.lost_after=5
```

A profile does both. It is a TOML file that you pass with `--profile`; the `run.toml` of a run is
one, too. `--send` chooses a sink. Its settings follow a `?` in the address, or are given as
`--set SINK.NAME=VALUE` ([sending poses](how_to/send_poses.md)).
"""
FINDINGS_HEAD = """# Findings

Tables, JSON and the studio carry codes. No program need read a sentence.

## Recordings and rigs

`check`, `run`, `live` and `mend` name causes, such as `clock` or `moved`:
[codes, what they mean, what mends them](../explanation/what_can_go_wrong.md#causes-that-are-named).
All other findings, of `calibrate` too, stand below, or have their topic as code.

## Poses, recordings and calibrations

Why a pose is missing, doubtful (status `flagged`), or made without some pictures; then what
`check`, `run` and `calibrate` find beside those causes. `doubts` of
[`poses.parquet`](../files.md#columns), of `summary.json` and of what is sent as JSON hold the code
and, by the names in braces, what varies: names of cameras and balls, and numbers, whose names end
in their unit. Where several are counted together, a number is a range `[lowest, highest]`, and all
names are listed. In a run of several bodies, `body` says whose doubt it is.

"""
SHARED_BY = 4  # An option that means the same in so many commands is described once
KINDS = {
    "detector": "Detectors",
    "triangulator": "Triangulators",
    "solver": "Pose solvers",
    "tracker": "Trackers",
    "estimator": "Estimators",
    "sink": "Sinks",
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages; MkDocs calls it with the files that it found in the folder."""
    from mkdocs.structure.files import File

    pages = {
        "cli.md": command_line_page,
        "settings.md": settings_page,
        "reference/findings.md": findings_page,
        "reference/plugins.md": plugin_page,
    }
    for address, make in pages.items():
        files.append(File.generated(config, address, content=make()))
    return files


def command_line_page() -> str:
    """The text of `docs/cli.md`."""
    app = build_app()
    names = [(name,) for name in commands() if name in app]
    subcommands = [(*n, sub) for n in names for sub in app[n[0]] if not sub.startswith("-")]
    pages = {words: help_of(*words) for words in [*names, *subcommands]}
    shared = Counter(row for page in pages.values() for row in page.rows)
    often = [row for row, n in shared.items() if n >= SHARED_BY and row[0].startswith("--")]
    parts = [HEAD, _overview(help_of()), _bullets(often)]
    parts += [_command(" ".join(words), page, often) for words, page in pages.items()]
    return "".join(parts)


def findings_page() -> str:
    """The text of `docs/reference/findings.md`."""
    rows = [
        [f"`{code}`", re.sub(r":[^{}]*}", "}", row["text"]), row["known"], row["remedy"]]
        for code, row in sentences().items()
    ]
    head = ["code", "sentence", "how it is known", "what mends it"]
    return f"{FINDINGS_HEAD}\n{table(head, rows)}"


class Help(NamedTuple):
    """What `--help` prints: how it is called, a sentence, and rows of names and words in boxes."""

    usage: str
    sentence: str
    boxes: dict[str, list[tuple[str, str]]]

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Of all boxes."""
        return [row for rows in self.boxes.values() for row in rows]


def help_of(*tokens: str) -> Help:
    """A command's help, as on a terminal so wide that nothing is folded."""
    out, before = io.StringIO(), dict(os.environ)
    os.environ.update(COLUMNS="2000", TERM="dumb", NO_COLOR="1")
    try:
        with contextlib.redirect_stdout(out):
            main([*tokens, "--help"])
    finally:
        os.environ.clear()
        os.environ.update(before)
    boxes: dict[str, list[tuple[str, str]]] = {}
    text, _, rest = out.getvalue().strip().partition("╭")
    for line in rest.splitlines():
        if line[:1] in ("─", "╭"):
            rows = boxes[line.strip("╭╮─ ")] = []
        elif row := re.match(r"│ (?:\* {2}| {0,3})(\S.*?)(?: {2,}(.*?))? *│$", line):
            rows.append((row[1], row[2] or ""))
        elif line.startswith("│"):  # A line of a docstring that goes on
            rows[-1] = rows[-1][0], f"{rows[-1][1]} {line.strip('│ ')}"
    usage, sentence = text.removeprefix("Usage: ").strip().split("\n\n", 1)
    return Help(usage.strip(), " ".join(sentence.split()), boxes)


def _overview(page: Help) -> str:
    """A table of all commands, by group, and what all of them take."""
    *groups, options = page.boxes
    rows = [
        [group if i == 0 else "", f"[`{name}`](#measure-{name})", said]
        for group in groups
        for i, (name, said) in enumerate(page.boxes[group])
    ]
    head = f"\n## measure\n\n{page.sentence}\n\n{table(['for', 'command', 'what it does'], rows)}"
    return f"{head}\n{_bullets(page.boxes[options])}\nOptions that several commands share:\n\n"


def _command(name: str, page: Help, often: list[tuple[str, str]]) -> str:
    """How it is called, what only it takes, and what others take, too."""
    rows = _bullets(row for row in page.rows if row not in often)
    if also := ", ".join(f"`{row[0].split()[0]}`" for row in page.rows if row in often):
        rows += f"- [shared](#measure): {also}\n"
    head = f"\n## measure {name}\n\n`{page.usage}`: {page.sentence}\n"
    return f"{head}\n{rows}" if rows else head


def _bullets(rows: Iterable[tuple[str, str]]) -> str:
    return "".join(f"- `{name}`: {said}\n" for name, said in rows)


def settings_page() -> str:
    """The text of `docs/settings.md`."""
    parts = [SETTINGS_HEAD, profiles_section()]
    own = [p for p in Registry.discover().loaded if p.distribution.name == "triball"]
    for kind, title in KINDS.items():
        found = sorted((p for p in own if p.kind == kind), key=lambda p: p.name)
        head = ["plugin, setting", "default", "unit", "type", "what it does"]
        rows = [row for item in found for row in plugin_rows(item)]
        parts.append(f"\n## {title}\n\n{table(head, rows)}")
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


def plugin_rows(item: Loaded) -> list[list[str]]:
    """The first sentence of a plugin's docstring, and a row for each of its settings."""
    words = (inspect.getdoc(item.plugin) or "").partition("\n\n")[0]
    head = [f"**{item.name}**", "", "", "", f"*{' '.join(words.split())}*"]
    return [head, *map(_setting_row, describe_settings(item.plugin.Config))]


def _setting_row(s: Setting) -> list[str]:
    shown = [f"`{s.default}`", s.unit, f"`{s.type}`".replace("|", "or"), s.description]
    return [f"`{s.name}`", *shown]


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)

"""The command line: one file per sub-command. Each parses, calls one function and prints.

`measure/cli/NAME.py` holds a function (or a cyclopts App) called NAME. Its docstring is its help,
its parameters are the arguments::

    def evaluate(run: Path, /, *, truth: Path | None = None, json: JsonFlag = False) -> None:

- The line that lists it in `measure --help` stands in `measure/cli/app.py`, so that no
  command is imported before it is chosen.
- The work is one call into `measure.api`, so that a notebook can do the same. It takes a
  `progress` callback: `with console.progress("evaluating") as report: ...`.
- Results go to stdout by `console.print_table`, `print_text` or, with `--json`, one `print_json`;
  everything else goes to stderr.
- `registry: InjectedRegistry` is handed in, and honours the global `--disable NAME`.
- What a user can mend is raised as `MeasureError` by whoever finds it; a command catches nothing.
- Parameters before `/` are positional, those after `*` are options; an option's name bears its
  unit (`--tolerance-ms`).
- An integer that a command returns is the exit code; otherwise that is 0.
"""

from measure.cli.app import build_app, main

__all__ = ["build_app", "main"]

"""The command line: one file per sub-command. Each parses, calls one function and prints.

`measure/cli/NAME.py` holds the command NAME. Where one function of `measure.api` does the work, it
is the command, with its docstring and its parameters, and the file only prints its result::

    @command(api.check, "looking")
    def check(found: SessionCheck, json: JsonFlag = False) -> int:

To add an option, add a parameter to the function of the api, with its line in the docstring; or a
field to the record of options that it takes. Any other command is a function (or a cyclopts App).
Its docstring is its help, its parameters are the arguments::

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

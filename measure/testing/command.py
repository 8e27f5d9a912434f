"""Conformance tests of commands."""

from __future__ import annotations

import contextlib
import io
from typing import ClassVar

from cyclopts import App

from measure.cli import main
from measure.neighbours import Command, commands, load_command


class CommandConformance:
    """Tests of a command that an installed package adds to `measure`."""

    name: ClassVar[str]  # as typed

    @property
    def command(self) -> Command:
        """What its package's table says."""
        assert self.name in commands(), f"no installed package declares {self.name}"
        return commands()[self.name]

    def test_its_function_says_what_the_table_says(self) -> None:
        """The help of all commands shows the one, its own help the other."""
        target = load_command(self.name)
        own = target.help if isinstance(target, App) else target.__doc__
        assert (own or "").partition("\n")[0] == self.command.line, "another first line"

    def test_it_is_listed(self) -> None:
        """In its group of `measure --help`."""
        assert f" {self.name} " in self.printed("--help"), "not in `measure --help`"

    def test_its_help_is_printed(self) -> None:
        """Every argument and option is explained."""
        assert f"Usage: measure {self.name}" in self.printed(self.name, "--help")

    def test_a_wrong_option_is_one_line(self) -> None:
        """And exit code 2, as everywhere."""
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            code = main([self.name, "--no-such-option-is-there"])
        assert code == 2, f"exit code {code}"
        assert said.getvalue().count("\n") == 1, said.getvalue()

    def printed(self, *words: str) -> str:
        """What words after `measure` print."""
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            main(list(words))
        return out.getvalue()

"""The frame around all sub-commands: global options, error lines and exit codes."""

from __future__ import annotations

import difflib
import errno
import gc
import os
import re
import signal
import sys
from collections.abc import Sequence
from importlib import metadata
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, Group, MissingArgumentError, Parameter, UnknownCommandError

from measure.errors import ConfigError, MeasureError
from measure.neighbours import commands, lacking
from measure.processes import Terminated, address_space_bytes, unwound_by_signals

DONE, MISTAKE, ENDED_BY = 0, 2, 128
"""Exit codes, the last plus the number of the signal. A defect of ours is an exception that nobody
foresaw: python prints it and exits with 1."""

_MACHINE_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EMFILE}
_MACHINE_FAULTS |= {errno.EFBIG, errno.ENOMEM}
"""Errors of the machine, not of the program: full or read-only disks, permissions, limits."""
_PATH_FAULTS = {errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG}
"""Errors of paths, which are the user's if the path is: a missing folder, a file in its place."""

_NO_MEMORY = ("Insufficient memory", "bad_alloc", "can't start new thread", "spawn thread")
"""What libraries say where there is no memory, by errors of other kinds."""

_LEAST_ADDRESS_BYTES = 3_500_000_000
"""With 2.6 GB libraries that compile, draw and decode abort or crash while they begin; 4 GB do."""
_MEMORY_USED_UP = (
    "the memory that this process may have is used up (`ulimit -v`, or all of the machine's); what "
    "was written before is kept: close other programs or raise the limit"
)

_CLAUSE_END = r"(?:;|\. )(?![^(]*\))"  # A semicolon or full stop, but not one in brackets


def main(tokens: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Args:
        tokens: the words after `measure`; those of the process if omitted.
    """
    # Adjusting cameras takes many products too small to share: threads of the linear algebra cost
    # a fifth more CPU time and gain none. The variable is read when NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _make_streams_safe()
    try:
        with unwound_by_signals():
            return _explained(sys.argv[1:] if tokens is None else list(tokens))
    except BrokenPipeError:
        return _pipe_closed()
    except SystemExit as end:
        # How rich, which prints tables and help, takes a broken pipe.
        if not isinstance(end.__context__, BrokenPipeError):
            raise
        return _pipe_closed()


def _explained(tokens: list[str]) -> int:
    """Run one command; errors that a user can mend are printed in one line."""
    try:
        code = _dispatch(tokens)
        sys.stdout.flush()
    except MeasureError as error:
        # Whatever stage met it is not to blame.
        return _mistake(_MEMORY_USED_UP if _is_short_of_memory(error.__cause__) else str(error))
    except UnicodeEncodeError as error:
        if error.reason != "surrogates not allowed":
            raise
        before, after = error.object[: error.start], error.object[error.start :]
        # In a text that holds the name, TOML say, it stands in quotation marks on one line.
        name = re.split(r'["\n]', before)[-1] + re.split(r'["\n]', after)[0]
        return _mistake(f"{name}: a name that is not in UTF-8 cannot be written down: rename it")
    except OSError as error:
        if not (error.errno in _MACHINE_FAULTS or _is_of_a_users_path(error)):
            raise
        where = f"{error.filename}: " if error.filename else ""
        return _mistake(f"{where}{error.strerror}")
    except Exception as error:
        if not _is_short_of_memory(error):
            raise
        return _mistake(_MEMORY_USED_UP)
    except Terminated as end:
        print(f"measure: ended by {end.signal.name}", file=sys.stderr)
        return ENDED_BY + end.signal
    except KeyboardInterrupt:
        print("measure: interrupted", file=sys.stderr)
        return ENDED_BY + signal.SIGINT
    return code


def _is_short_of_memory(error: BaseException | None) -> bool:
    """Whether an error was, or was made from, one of memory: NumPy's, OpenCV's, C++'s, threads'."""
    while error is not None:
        if isinstance(error, MemoryError) or any(word in str(error) for word in _NO_MEMORY):
            return True
        error = error.__cause__ or error.__context__
    return False


def _pipe_closed() -> int:
    """The reader of the output has gone (`measure ... | head`): write nothing more.

    Python would flush the rest when it ends, and print an error.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return ENDED_BY + getattr(signal, "SIGPIPE", 13)  # Windows has none


def _make_streams_safe() -> None:
    """Write escapes for letters that stdout or stderr do not know, and nowhere if they are closed.

    A closed one would be `None`, and its number go to the next file that is opened: libraries that
    write there themselves would write into that.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # Open until the process ends.
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        stream = getattr(sys, name)
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _is_of_a_users_path(error: OSError) -> bool:
    """Whether a path is to blame that is none of the program's own."""
    if error.errno not in _PATH_FAULTS or not isinstance(error.filename, str | bytes | Path):
        return False
    own = Path(__file__).resolve().parents[1]
    return own not in Path(os.fsdecode(error.filename)).resolve().parents


def build_app() -> App:
    """The tree of sub-commands, none of them imported yet."""
    app = App(
        name="measure",
        help="The 6-DoF pose of a body with coloured balls on it, seen by cheap cameras.",
        version=lambda: f"measure {metadata.version('triball')}",
        help_format="plaintext",
        default_parameter=Parameter(negative=(), show_default=_worth_showing),
        suppress_keyboard_interrupt=False,
    )
    groups: dict[str, Group] = {}
    for place, (name, command) in enumerate(commands().items()):
        group = groups.setdefault(command.group, Group.create_ordered(command.group))
        if command.line:
            app.command(command.target, name=name, help=command.line, group=group, sort_key=place)
    app["--help"].group = app["--version"].group = Group.create_ordered("Options")
    app.register_install_completion_command(
        group=app["--help"].group, help="Complete words by Tab in your shell from now on."
    )
    app.group_parameters = app.meta.group_parameters = Group.create_ordered("Options")
    app.meta.suppress_keyboard_interrupt = False
    return app


def _worth_showing(default: object) -> Any:
    """A default as the help shows it: None, nothing at all, for "off", "none" and "empty"."""
    return None if default is False or default in (None, (), [], "") else str(default)


def _dispatch(tokens: list[str]) -> int:
    app = build_app()

    @app.meta.default
    def launch(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        disable: Annotated[tuple[str, ...], Parameter(show=False)] = (),
    ) -> int:
        """Run a command.

        Args:
            words: the command and its arguments.
            disable: Leave out a plugin or a distribution, without importing it; may be repeated.
        """
        command, bound, ignored = app.parse_args(words, exit_on_error=False, print_error=False)
        injected = {}
        if "registry" in ignored:  # an argument that is not typed
            from measure.host import Registry

            injected["registry"] = Registry.discover(disable)
        if (limit := address_space_bytes()) < _LEAST_ADDRESS_BYTES:
            raise ConfigError(
                f"this process may have {limit / 1e9:.1f} GB of address space (`ulimit -v`), and "
                f"{_LEAST_ADDRESS_BYTES / 1e9:.1f} GB are needed: raise that limit"
            )
        gc.freeze()  # What is imported stays; looking through it again took 0.2 s of a run
        result = command(*bound.args, **bound.kwargs, **injected)
        return result if isinstance(result, int) else DONE

    try:
        return int(
            app.meta(tokens, exit_on_error=False, print_error=False, result_action="return_value")
            or DONE
        )
    except CycloptsError as error:
        return _mistake(_explain(error, tokens))


def _explain(error: CycloptsError, tokens: Sequence[str]) -> str:
    """A usage error in one line, with near names and where to read on."""
    chain = " ".join(error.command_chain or ())
    if isinstance(error, UnknownCommandError) and not chain:
        # Not str(error): it imports every command to list them.
        known = [*commands(), "--disable", "--help", "--version"]
        unknown = (error.unused_tokens or list(tokens))[0]
        if unknown in commands():
            return str(lacking(f"`measure {unknown}`", commands()[unknown].package))
        near = difflib.get_close_matches(unknown, known, n=3)
        hint = f" Did you mean {' or '.join(near)}?" if near else ""
        what = "option" if unknown.startswith("-") else "command"
        text = f"there is no {what} '{unknown}'.{hint}"
    elif isinstance(error, MissingArgumentError) and error.argument is not None:
        text = f"{chain} needs {_what_to_give(error)}"
    else:
        error.verbose = False
        text = str(error)
        text = text[:1].lower() + text[1:]
    return f"{text} See `{' '.join(f'measure {chain}'.split())} --help`."


def _what_to_give(error: MissingArgumentError) -> str:
    """Names of a missing argument, and the first clause of its help."""
    if error.argument is None or error.app is None:
        return "an argument more."
    first, *others = error.argument.names
    names = f"{first} (or {', '.join(others)})" if others else first
    known = error.app.assemble_argument_collection(parse_docstring=True)
    texts = [one.parameter.help or "" for one in known if first in one.names]
    meaning = re.split(_CLAUSE_END, "".join(texts))[0].rstrip(".")
    return f"{names}: {meaning}." if meaning else f"{names}."


def _mistake(message: str) -> int:
    sys.stdout.flush()
    print(f"measure: {' '.join(message.split())}", file=sys.stderr)
    return MISTAKE

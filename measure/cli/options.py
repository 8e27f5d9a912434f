"""Commands from functions of the api, and the options that several commands share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_args

from cyclopts import Parameter

from measure import api
from measure.api.profiles import DEFAULT_PROFILE
from measure.cli import console
from measure.cli.console import CalibrationFormat, OutFile, Overwrite
from measure.host import Registry
from measure.measuring import Profile
from measure.measuring.pipeline import Stage

InjectedRegistry: TypeAlias = Annotated[Registry, Parameter(parse=False)]
"""Type of a command's keyword `registry`: all plugins but those left out with `--disable`."""
FIELDS = Parameter(name="*", parse=r"^(?!on_|stop$|sink_settings$)")
"""Of a record in a command's signature: its fields are options, explained by its docstring; but for
those that only a program can give."""
Recording = Annotated[bool, Parameter(negative="--no-recording")]
Spawn = Annotated[bool, Parameter(help="open the viewer at once and watch.")]

RequiredOut = Annotated[Path, Parameter(name=("--out", "-o"), required=True)]
"""Of an output that only the command needs: what is returned is enough for a notebook."""

_BY_NAME = {
    "out": OutFile | None,
    "overwrite": Overwrite,
    "file_format": CalibrationFormat,
    "profile": str,
    "registry": InjectedRegistry,
}
"""Types of parameters as options, by what the api calls them everywhere."""
_BY_TYPE = {Path | str: Path, Path | str | None: Path | None}


def command(
    work: Callable[..., Any],
    doing: str = "",
    unit: str = "frame sets",
    *,
    arguments: int = 1,
    **types: Any,
) -> Callable[[Callable[..., int | None]], Callable[..., int | None]]:
    """Make a command of a function of the api; what is decorated prints its result.

    The command has the docstring of the function, and its parameters: the first are arguments, the
    others are options. The printer takes the result, and by their names whichever of the
    parameters it needs. What else it takes, such as `json`, becomes an option, too. An integer
    that it returns is the exit code.

    Args:
        work: the function; `registry` and `progress` are handed to it.
        doing: what the progress is called ("measuring").
        unit: what it counts, plural.
        arguments: how many parameters are arguments.
        types: of parameters as options, where they are others than in the api.
    """

    def made(show: Callable[..., int | None]) -> Callable[..., int | None]:
        parameters = dict(inspect.signature(work, eval_str=True).parameters)
        reports = parameters.pop("progress", None) is not None
        shown = [*inspect.signature(show, eval_str=True).parameters.values()][1:]
        own = {one.name: one for one in shown if one.name not in parameters}
        signature = inspect.Signature(
            [
                one.replace(
                    kind=one.POSITIONAL_ONLY if place < arguments else one.KEYWORD_ONLY,
                    annotation=types.get(one.name) or _as_option(one),
                )
                for place, one in enumerate([*parameters.values(), *own.values()])
            ]
        )

        def run(*words: Any, **options: Any) -> int | None:
            bound = signature.bind(*words, **options)
            bound.apply_defaults()
            given = {name: bound.arguments[name] for name in parameters}
            if reports:
                with console.progress(doing, unit) as report:
                    result = work(**given, progress=report)
            else:
                result = work(**given)
            return show(result, **{one.name: bound.arguments[one.name] for one in shown})

        run.__doc__, run.__signature__ = work.__doc__, signature  # type: ignore[attr-defined]
        run.__annotations__ = {n: one.annotation for n, one in signature.parameters.items()}
        return run

    return made


def _as_option(given: inspect.Parameter) -> Any:
    """The type of a parameter of the api as an option."""
    if is_dataclass(given.annotation):
        return Annotated[given.annotation, FIELDS]
    return _BY_NAME.get(given.name) or _BY_TYPE.get(given.annotation, given.annotation)


@Parameter(name="*")
@dataclass(frozen=True)
class DetectorOptions:
    """The profile, and what is changed of its detector.

    Attributes:
        profile: `precise`, `paper`, or the path of a profile of your own (.toml).
        detector: a detector plugin to use instead of the profile's.
        set_: a setting as STAGE.NAME=VALUE, such as detector.rays=128; may be repeated.
    """

    profile: str = DEFAULT_PROFILE
    detector: str | None = None
    set_: tuple[str, ...] = ()

    def chosen(self) -> Profile:
        """The profile with the changes."""
        stages = {stage: getattr(self, stage, None) for stage in get_args(Stage)}
        return api.choose(api.load_profile(self.profile), stages, self.set_)


@Parameter(name="*")
@dataclass(frozen=True)
class ProfileOptions(DetectorOptions):
    """The profile, and what is changed of any of its stages.

    Attributes:
        triangulator: name of a triangulator.
        solver: name of a pose solver.
    """

    triangulator: str | None = None
    solver: str | None = None


def viewer(connect: str | None, spawn: bool) -> str | None:
    """Address of the viewer, which is opened if `spawn` asks for it."""
    from measure.viewing.viewer import open_viewer

    return open_viewer([]).listens if spawn else connect
